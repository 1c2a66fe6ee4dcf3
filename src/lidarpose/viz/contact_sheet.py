"""People of a dataset on a contact sheet, or on a page to turn them in 3D."""

from math import isnan
from pathlib import Path

import numpy as np

from lidarpose.data.shards import CARD, DatasetReader, counted, open_dataset, read_rows
from lidarpose.errors import InputError
from lidarpose.io.files import check_apart, file_error
from lidarpose.sample import Box, LabeledSample, PersonInfo, Pose
from lidarpose.skeleton import skeleton
from lidarpose.viz.bird_eye import MAX_SCANS, ScanPanel, draw_scans
from lidarpose.viz.draw import MAX_PEOPLE, Panel, draw_people
from lidarpose.viz.html import ReportPerson, write_report


def draw_dataset(folder: str | Path, *, count: int = 24, html: bool = False, out: str | Path | None = None) -> Path:
    """Draws `count` people of a dataset, evenly spread over it, and returns the file's path. A picture of streets shows
    at most 12 of them from above.

    out: the file, by default the folder's name with .png or .html in the current folder. Raises InputError for a
    folder that is no dataset or has no shard yet, and a file that cannot be written.
    """
    most = 400 if html else MAX_PEOPLE
    if not 1 <= count <= most:
        raise InputError(f"expected 1 to {most} people to draw, got {count}")
    dataset = open_dataset(folder)
    name = Path(folder).resolve().name
    path = Path(out) if out is not None else Path(f"{name}.{'html' if html else 'png'}")
    check_apart(path, dataset.folder / CARD, *dataset.folder.glob("*.parquet"))
    is_streets = "frames" in dataset.card.tables and not html
    # each with the number that it has in the dataset
    rows = [] if is_streets else _spread(dataset, count)
    people = [(row["index"], dataset.sample(row)) for row in rows]
    settings = dataset.card.settings
    title = f"{name}: {counted(dataset.card.count, settings.get('what', 'people'))}"
    if "scene" in settings:
        title += f", scene {settings['scene']}"
    if (written := len(dataset.written())) < dataset.card.shards:
        title += f", {written:,} of {dataset.card.shards:,} shards written so far"
    if is_streets:
        draw_scans(_street_panels(dataset, min(count, MAX_SCANS)), path, title=title)
    elif html:
        lines = [_line(sample, _label(index, sample, dataset)) for index, sample in people]
        cards = [_card(sample, _label(index, sample, dataset)) for index, sample in people]
        write_report(path, cards, title=title, summary=lines)
    else:
        panels = [_panel(sample, _label(index, sample, dataset)) for index, sample in people]
        draw_people(panels, path, title=title)
    return path


def _street_panels(dataset: DatasetReader, count: int) -> list[ScanPanel]:
    """`count` streets, evenly spread over the shards that are there, in their first frame."""
    there = _written(dataset, "frames")
    index = {shard: read_rows(dataset.path(shard, "frames"), "frames", ("index",)) for shard in there}
    streets = [(shard, k) for shard in there for k in sorted({row["index"] for row in index[shard]})]
    chosen = [streets[k] for k in np.linspace(0, len(streets) - 1, min(count, len(streets))).round().astype(int)]
    panels = []
    for shard in sorted({shard for shard, _ in chosen}):
        frames: dict[int, list[dict]] = {}
        for row in dataset.rows("frames", [shard]):
            frames.setdefault(row["index"], []).append(row)
        panels += [_street_panel(frames[k], dataset) for number, k in chosen if number == shard]
    return panels


def _street_panel(rows: list[dict], dataset: DatasetReader) -> ScanPanel:
    first = rows[0]
    # everybody is in every frame
    boxes = np.stack([row["box"].reshape(-1, 7) for row in rows if len(row["box"]) == len(first["box"])])
    joints = first["joints"].reshape(len(first["track"]), -1, 3)
    return ScanPanel(
        points=first["points"].reshape(-1, 3),
        boxes=[
            Box(center=box[:3], size=box[3:6], yaw=float(box[6]), id=track)
            for track, box in zip(first["track"].tolist(), boxes[0], strict=True)
        ],
        poses=Pose(joints=joints, skeleton=skeleton(dataset.card.skeleton)) if len(joints) else None,
        tracks=list(boxes[:, :, :2].swapaxes(0, 1)),
        label=f"#{first['index']} {first['sensor']}: {counted(len(joints), 'people')}, {len(rows)} frames",
    )


def _written(dataset: DatasetReader, table: str | None = None) -> list[int]:
    """Numbers of the shards of a table, by default of people, that are there. Raises InputError where none is."""
    there = dataset.written(table)
    if not there:
        again = f"wait for the first one, or run {dataset.card.writer} again"
        raise file_error(dataset.folder, f"holds no shard yet; {again}")
    return there


def _spread(dataset: DatasetReader, count: int) -> list[dict]:
    """`count` rows, evenly spread over the shards that are there; of a smaller dataset all rows."""
    there = _written(dataset)
    sizes = [dataset.rows_of(dataset.card.people, shard) for shard in there]
    total = sum(sizes)
    count = min(count, total)
    # each in the middle of an equal share of the rows
    wanted = ((2 * np.arange(count) + 1) * total // (2 * count)).tolist()
    rows, first = [], 0
    for shard, size in zip(there, sizes, strict=True):
        here = {w - first for w in wanted if first <= w < first + size}
        if here:
            rows += [row for k, row in enumerate(dataset.rows(shards=[shard])) if k in here]
        first += size
    return rows


def _label(index: int, sample: LabeledSample, dataset: DatasetReader) -> str:
    """As "#12 os1-128"; of clips and streets with the frame and the track."""
    words = [f"#{index}"]
    if dataset.card.settings.get("what") in ("clips", "streets"):
        words.append(f"frame {sample.frame}")
    if "frames" in dataset.card.tables:
        words.append(f"track {sample.track}")
    sensor = sample.info.sensor if sample.info else ""
    return " ".join([*words, sensor or sample.source.rpartition("/")[2]])


def _panel(sample: LabeledSample, label: str) -> Panel:
    distance = None if isnan(sample.distance) else sample.distance
    return Panel(points=sample.points, truth=sample.pose, part=sample.part, label=label, distance=distance)


def _card(sample: LabeledSample, label: str) -> ReportPerson:
    caption = f"{len(sample.points):,} points"
    if not isnan(sample.distance):
        # as in the table above
        caption += f" · {sample.distance:.1f} m"
    return ReportPerson(label=label, points=sample.points, truth=sample.pose, part=sample.part, caption=caption)


def _line(sample: LabeledSample, label: str) -> dict:
    line = {"person": label, "points": len(sample.points)}
    info = sample.info or PersonInfo()
    if info.kind:
        line["does"] = info.kind
    if not isnan(sample.distance):
        line["distance m"] = round(sample.distance, 1)
    for name in ("visible", "clutter"):
        if not isnan(share := getattr(info, name)):
            line[f"{name} %"] = round(100 * share)
    return line
