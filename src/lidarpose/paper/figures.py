"""The paper's figures 5 to 8, drawn from the results of their tables' cells."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.eval.charts import compare_ends, compare_stability
from lidarpose.eval.dataset import open_eval_dataset
from lidarpose.eval.predictions import read_poses
from lidarpose.eval.protocols import crop_of
from lidarpose.eval.scores import FILE, read_scores
from lidarpose.io.atomic import write_atomic
from lidarpose.paper.cells import Cell
from lidarpose.paper.report import can_be_drawn, stability_study
from lidarpose.paper.steps import POSES, Step
from lidarpose.sample import Pose, facing
from lidarpose.skeleton import SMPL24
from lidarpose.synth.bodies import PoseBank
from lidarpose.synth.generator import Generator
from lidarpose.synth.scene import scene_config
from lidarpose.viz.draw import Panel, draw_people

# number of people drawn side by side: those with the largest errors, averaged over the methods
HARDEST = 6
# Figure 6: distances, m, and shares of points kept
_DISTANCES, _KEPT = (5.0, 8.0, 12.0, 16.0, 20.0), (1.0, 0.8, 0.6, 0.4)
# a person stands if lowest and highest joint are at least this far apart, m; number of people tried, and their seed
_STANDS, _TRIED, _SEED = 1.5, 100, 0


def draw(name: str, cells: Sequence[Cell], out: Path) -> list[Path]:
    """Draws fig5, fig7 or fig8 from the finished cells of the first seed, one picture per column; returns the paths."""
    columns = list(dict.fromkeys(cell.column for cell in cells))
    paths = []
    for column in columns:
        first_seed_cells = [cell for cell in cells if cell.seed == 0 and cell.column == column]
        done_cells = {
            cell.row: cell for cell in first_seed_cells if cell.evaluation and can_be_drawn(name, cell.evaluation, out)
        }
        if done_cells:
            paths.append(out / (f"{name}.png" if len(columns) == 1 else f"{name}-{column}.png"))
            write_atomic(paths[-1], _picture(name, done_cells, out))
    return paths


def _picture(name: str, cells: dict[str, Cell], out: Path) -> bytes:
    """A figure of one column, from its finished cells."""
    if name == "fig5":
        return _side_by_side(cells, out)
    target = next(iter(cells.values())).target
    title = "the stand-in" if isinstance(target.test, Step) else target.title
    studies = {
        row: _titled(study, title)
        for row, cell in cells.items()
        if cell.evaluation and (study := stability_study(cell.evaluation, out))
    }
    return (compare_stability if name == "fig7" else compare_ends)(studies)


def _titled(study: dict[str, Any], title: str) -> dict[str, Any]:
    """A study of stability.json with a title in place of the dataset's folder name."""
    dataset = study["setting"]["dataset"]
    return study | {"who": study["who"].replace(dataset, title), "setting": study["setting"] | {"dataset": title}}


def _side_by_side(cells: dict[str, Cell], out: Path) -> bytes:
    """The people with the largest errors, one row per person and one column per method."""
    paths = {row: cell.evaluation.product(out) / POSES for row, cell in cells.items() if cell.evaluation}
    predictions = {row: next(iter(read_poses(path).values())) for row, path in paths.items()}
    index_by_key = [
        {(s, r): k for k, (s, r) in enumerate(zip(p.shard, p.row, strict=True))} for p in predictions.values()
    ]
    common_keys = sorted(set.intersection(*map(set, index_by_key)))
    tables = zip((p.errors() for p in predictions.values()), index_by_key, strict=True)
    errors = np.array([[table[index[key]] for key in common_keys] for table, index in tables])
    mean = _mean(errors)
    overall = _mean(mean.T)
    # a person without labels, or without a pose by any method, has no error
    hardest_keys = [common_keys[k] for k in np.argsort(-overall, kind="stable") if not np.isnan(overall[k])][:HARDEST]
    target = next(iter(cells.values())).target
    folder = target.test.product(out) if isinstance(target.test, Step) else target.test
    # all methods have the same crops
    setting = read_scores(next(iter(paths.values())).with_name(FILE)).results[0].setting
    hardest = [person for person in open_eval_dataset(folder) if (person.shard, person.row) in hardest_keys]
    clouds = {(person.shard, person.row): person.points[crop_of(person, setting)[0]] for person in hardest}
    panels = []
    for key in hardest_keys:
        for k, (row, p) in enumerate(predictions.items()):
            row_index = index_by_key[k][key]
            pose, truth = (
                Pose(joints=joints[row_index].astype(float), skeleton=p.skeleton) for joints in (p.pred, p.true)
            )
            # viewed along the true facing, so that all columns show the same side whatever the predicted facing
            panel = Panel(points=clouds[key], pose=pose, truth=truth, forward=facing(truth))
            error = mean[k, common_keys.index(key)]
            label = f"{row}: no pose" if np.isnan(error) else f"{row}: {error:.0f} mm"
            panels.append(replace(panel, label=label, distance=float(p.distance[row_index])))
    return draw_people(panels, title=f"{target.title}: the hardest people", per_row=len(predictions))


def _mean(values: np.ndarray) -> np.ndarray:
    """The mean of the values that are not NaN along the last axis; NaN if there are none."""
    count = (~np.isnan(values)).sum(-1)
    return np.where(count > 0, np.nansum(values, -1) / np.maximum(count, 1), np.nan)


def draw_one_body(out: Path, *, motion: str | None = None, subjects: tuple[str, ...] | None = None) -> Path:
    """Figure 6: one synthesized body at several distances (rows) under several laser masks (columns). subjects: of the
    motion, None for all."""
    bank = PoseBank.from_clips(motion, subjects) if motion else None
    panels, index = [], -1
    for distance in _DISTANCES:
        for keep in _KEPT:
            scene = replace(scene_config("paper").changed((f"keep={keep}",)), distance=(distance, distance))
            generator = Generator(scene=scene, bank=bank, captured=float(bank is not None), redraw=False, measure=False)
            # with the same seed and index, the body is the same in every scene
            index = index if index >= 0 else _standing(generator)
            sample = generator.person(_SEED, index).sample
            joints = sample.pose.to(SMPL24).joints if sample.pose else None
            truth = None if joints is None else Pose(joints=joints, skeleton=SMPL24)
            label = f"{distance:g} m, r_keep {keep:g}"
            panels.append(Panel(points=sample.points, truth=truth, part=sample.part, label=label))
    picture = draw_people(panels, title="one body at several distances, with several masks", per_row=len(_KEPT))
    write_atomic(out / "fig6.png", picture)
    return out / "fig6.png"


def _standing(generator: Generator) -> int:
    """The index of the first standing person, or 0 if none is found."""
    for index in range(_TRIED):
        pose = generator.person(_SEED, index).sample.pose
        if pose is not None and np.ptp(pose.joints[:, 2]) > _STANDS:
            return index
    return 0
