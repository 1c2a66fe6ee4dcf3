"""What a prepared dataset holds, told from its shards alone, so that it is the same however often a run was stopped."""

from collections import Counter
from typing import Any

import numpy as np

from lidarpose.data.shards import DatasetReader, read_rows, shard_path
from lidarpose.data.splits import SplitRule
from lidarpose.io.files import file_error
from lidarpose.sample import HIDDEN, SEEN, UNLABELED
from lidarpose.skeleton import skeleton

_COLUMNS = ("sequence", "frame", "split", "source", "joints", "joint_labels", "center")
# people whose trunks lean more than this on average are in a frame whose z is not up
_LEAST_UP = 0.7
# the middle of a person's points is hardly ever so far from the middle of the joints, m
_FAR = 1.0


def summarize(
    dataset: DatasetReader, *, parts: list[str], absent: dict[str, list[str]], rule: SplitRule | None
) -> dict[str, Any]:
    """The summary of `prepare`: counts, and warnings of what looks wrong. absent: split -> sequences not there."""
    labels: Counter[int] = Counter()
    splits: Counter[str] = Counter()
    sources: Counter[str] = Counter()
    reasons: Counter[str] = Counter()
    examples: dict[str, str] = {}
    frames: set[tuple[str, int]] = set()
    trunks, apart, table = [], [], []
    names = skeleton(dataset.card.skeleton).joints
    ends = [[names.index(f"{side}_{joint}") for side in ("left", "right")] for joint in ("hip", "shoulder")]
    for shard, part in enumerate(parts):
        people, skipped = 0, 0
        path = shard_path(dataset.folder, "labelled", shard)
        for row in read_rows(path, "labelled", _COLUMNS):
            if any(row[name] is None for name in _COLUMNS if name != "split") or len(row["joints"]) != 3 * len(names):
                raise file_error(path, "has a row that is no sample; delete it and run the same command again")
            people += 1
            frames.add((row["sequence"], row["frame"]))
            splits[row["split"] or "none"] += 1
            sources[row["source"]] += 1
            labels.update(row["joint_labels"].tolist())
            joints = row["joints"].reshape(-1, 3)
            there = ~np.isnan(joints[:, 0])
            if there.any():
                apart.append(float(np.linalg.norm(joints[there].mean(0) - row["center"])))
            hips, shoulders = (joints[pair].mean(0) for pair in ends)
            if not np.isnan(shoulders - hips).any():
                trunks.append((shoulders - hips) / max(float(np.linalg.norm(shoulders - hips)), 1e-6))
        for row in read_rows(shard_path(dataset.folder, "skipped", shard), "skipped"):
            skipped += 1
            reasons[row["reason"]] += 1
            examples.setdefault(row["reason"], row["where"])
        table.append({"part": part, "people": people, "skipped": skipped})
    trunk = np.mean(trunks, 0) if trunks else None
    found = {
        "people": sum(splits.values()),
        "frames": len(frames),
        "splits": dict(sorted(splits.items())),
        "sources": dict(sorted(sources.items())),
        "joints": {"seen": labels[SEEN], "hidden": labels[HIDDEN], "unlabelled": labels[UNLABELED]},
        "skipped": dict(reasons.most_common()),
        "skipped_first": examples,
        "trunk": None if trunk is None else [round(float(v), 3) for v in trunk],
        "joints_from_center_m": round(float(np.median(apart)), 3) if apart else None,
        "parts": table,
    }
    return found | {"warnings": _warnings(found, absent, rule)}


def _warnings(found: dict[str, Any], absent: dict[str, list[str]], rule: SplitRule | None) -> list[str]:
    lines = []
    if not found["people"]:
        lines.append("there is nobody in it; see what was skipped")
    if found["trunk"] is not None and found["trunk"][2] < _LEAST_UP:
        lines.append(f"people stand along {found['trunk']} on average, expected z up: turn the dataset first")
    if found["joints_from_center_m"] is not None and found["joints_from_center_m"] > _FAR:
        far = found["joints_from_center_m"]
        lines.append(f"joints are {far:.2f} m from the points in the median: labels and clouds of different releases?")
    empty = [part["part"] for part in found["parts"] if not part["people"]]
    if empty and found["people"]:
        lines.append(f"nobody in {_some(empty)}")
    if rule is not None:
        lines += [f"of {split} by {rule.name} {_some(names)} are not there" for split, names in absent.items()]
        if rule.leaks:
            lines.append(f"the split {rule.name} leaks: {rule.leaks}")
    return lines


def lines_of(summary: dict[str, Any]) -> list[str]:
    """The summary for a terminal, a line each: people, what was skipped with an example, warnings."""
    splits = ", ".join(f"{split} {count:,}" for split, count in summary["splits"].items())
    lines = [f"{summary['people']:,} people in {summary['frames']:,} frames ({splits or 'none'})"]
    for reason, count in summary["skipped"].items():
        lines.append(f"skipped {count:,}: {reason} (first: {summary['skipped_first'][reason]})")
    return lines + [f"warning: {line}" for line in summary["warnings"]]


def _some(names: list[str]) -> str:
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return f"{', '.join(names[:5])}{more}"
