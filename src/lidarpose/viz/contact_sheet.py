"""Draws people of a dataset on a contact sheet, or on an HTML page with 3D views."""

from math import isnan
from pathlib import Path

import numpy as np

from lidarpose.data.dataset_card import CARD, content_count
from lidarpose.data.shards import DatasetReader, open_dataset
from lidarpose.errors import InputError
from lidarpose.io.atomic import check_suffix, write_atomic
from lidarpose.io.files import check_not_input, file_error
from lidarpose.sample import Box, LabeledSample, PersonInfo, Pose
from lidarpose.skeleton import skeleton
from lidarpose.viz.bird_eye import MAX_SCANS, ScanPanel, draw_scans
from lidarpose.viz.draw import MAX_PEOPLE, Panel, draw_people
from lidarpose.viz.html import render_report


def draw_dataset(folder: str | Path, *, count: int = 24, html: bool = False, out: str | Path | None = None) -> Path:
    """Draws people of a dataset written by `synth` or `prepare`; for datasets of streets, the streets from above.

    Args:
        folder: the dataset's folder.
        count: number of people, or of streets (at most 12), evenly spread over the existing shards.
        html: writes a page with 3D views instead of a picture; for streets, it shows the streets and then the people.
        out: the output file; by default the folder's name with .png or .html in the current folder.

    Returns:
        The file's path.

    Raises:
        InputError: for fewer than one person or more than 60 (400 on a page), a folder that is not a dataset or has no
            shard yet, and an output file that cannot be written or belongs to the dataset.
    """
    limit = 400 if html else MAX_PEOPLE
    if not 1 <= count <= limit:
        raise InputError(f"expected 1 to {limit} people to draw, got {count}")
    dataset = open_dataset(folder)
    name = Path(folder).resolve().name
    path = Path(out) if out is not None else Path(f"{name}.{'html' if html else 'png'}")
    check_not_input(path, dataset.folder / CARD, *dataset.folder.glob("*.parquet"))
    check_suffix(path, *((".html", ".htm") if html else (".png",)))
    settings = dataset.card.settings
    title = f"{name}: {content_count(dataset.card.count, settings.get('what', 'people'))}"
    if "scene" in settings:
        title += f", scene {settings['scene']}"
    if (num_written := len(dataset.written())) < dataset.card.shards:
        title += f", {num_written:,} of {dataset.card.shards:,} shards written so far"
    streets: list[ScanPanel] = []
    if "frames" in dataset.card.tables:
        streets = [_street_panel(rows, dataset) for rows in _spread(dataset, "frames", min(count, MAX_SCANS))]
        if not html:
            write_atomic(path, draw_scans(streets, title=title))
            return path
    samples = [(row["index"], dataset.sample(row)) for (row,) in _spread(dataset, dataset.card.people, count)]
    panels = [_panel(index, sample, dataset) for index, sample in samples]
    if html:
        summary = [_summary_row(panel.label, sample) for panel, (_, sample) in zip(panels, samples, strict=True)]
        page = render_report(panels, title=title, summary=summary, scans=streets)
        write_atomic(path, page.encode("utf-8", "replace"))
    else:
        write_atomic(path, draw_people(panels, title=title))
    return path


def _spread(dataset: DatasetReader, table: str, count: int) -> list[list[dict]]:
    """Rows of `count` people (one each) or streets (one per frame), evenly spread over the existing shards; all if
    there are fewer. Raises InputError if there is no shard."""
    written_shards = dataset.written(table)
    if not written_shards:
        remedy = f"wait for the first one, or run {dataset.card.writer} again"
        raise file_error(dataset.folder, f"holds no shard yet; {remedy}")
    by_index, per_shard = table == "frames", dataset.card.per_shard
    if by_index:
        keys = {
            shard: range(shard * per_shard, min((shard + 1) * per_shard, dataset.card.count))
            for shard in written_shards
        }
    else:
        keys = {shard: range(dataset.rows_of(table, shard)) for shard in written_shards}
    total = sum(map(len, keys.values()))
    count = min(count, total)
    # the middles of `count` equal intervals
    positions = ((2 * np.arange(count) + 1) * total // (2 * count)).tolist()
    groups: list[list[dict]] = []
    first_position = 0
    for shard, numbers in keys.items():
        rows_by_key: dict[int, list[dict]] = {
            numbers[position - first_position]: []
            for position in positions
            if 0 <= position - first_position < len(numbers)
        }
        for number, row in enumerate(dataset.rows(table, [shard]) if rows_by_key else ()):
            rows_by_key.get(row["index"] if by_index else number, []).append(row)
        groups += [rows for rows in rows_by_key.values() if rows]
        first_position += len(numbers)
    return groups


def _street_panel(rows: list[dict], dataset: DatasetReader) -> ScanPanel:
    first_row = rows[0]
    # all people are in every frame
    boxes = np.stack([row["box"].reshape(-1, 7) for row in rows if len(row["box"]) == len(first_row["box"])])
    joints = first_row["joints"].reshape(len(first_row["track"]), -1, 3)
    people = content_count(len(joints), "people")
    return ScanPanel(
        points=first_row["points"].reshape(-1, 3),
        boxes=[
            Box(center=box[:3], size=box[3:6], yaw=float(box[6]), id=track)
            for track, box in zip(first_row["track"].tolist(), boxes[0], strict=True)
        ],
        poses=Pose(joints=joints, skeleton=skeleton(dataset.card.skeleton)) if len(joints) else None,
        labeled=True,
        tracks=list(boxes[:, :, :2].swapaxes(0, 1)),
        label=f"#{first_row['index']} {first_row['sensor']}: {people}, {len(rows)} frames",
    )


def _panel(index: int, sample: LabeledSample, dataset: DatasetReader) -> Panel:
    """A panel labeled as "#12 os1-128"; for clips and streets also with the frame, for streets also with the track; for
    prepared datasets as "sequence frame track"."""
    if dataset.card.people == "labelled":
        words = [sample.sequence, str(sample.frame), sample.track]
    else:
        words = [f"#{index}"]
        if dataset.card.settings.get("what") in ("clips", "streets"):
            words.append(f"frame {sample.frame}")
        if "frames" in dataset.card.tables:
            words.append(f"track {sample.track}")
        words.append((sample.info and sample.info.sensor) or sample.source.rpartition("/")[2])
        words += sample.conditions
    label = " ".join(words)
    return Panel(points=sample.points, truth=sample.pose, part=sample.part, label=label, distance=sample.distance)


def _summary_row(label: str, sample: LabeledSample) -> dict:
    row: dict = {"person": label, "points": len(sample.points)}
    info = sample.info or PersonInfo()
    if info.kind:
        row["does"] = info.kind
    if not isnan(sample.distance):
        row["distance m"] = round(sample.distance, 1)
    for name in ("visible", "clutter"):
        if not isnan(share := getattr(info, name)):
            row[f"{name} %"] = round(100 * share)
    return row
