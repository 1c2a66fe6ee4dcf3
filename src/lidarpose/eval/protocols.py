"""How a person is cut out and centered before a network sees them: two protocols, whose figures are not comparable.

clean   what a user has: the crop is a detector's box (the labelled one, displaced, see `jittered`), the center comes
        from the points alone, and no sequence is in both training and test
dapt    what the paper's released code does: crop and center from the labels, one pass, its splits
"""

from dataclasses import dataclass, replace

import numpy as np

from lidarpose.data.dapt_crops import released_view
from lidarpose.errors import InputError, check_name
from lidarpose.eval.dataset import Person
from lidarpose.sample import Box

PROTOCOLS = ("clean", "dapt")

# standard deviations of a detector's errors, each cut at twice itself: of the center along x and y, and along z, m; of
# the logarithm of each edge; of the yaw, rad
CENTER_SIGMA, HEIGHT_SIGMA, SIZE_SIGMA, YAW_SIGMA = 0.1, 0.05, 0.05, 0.1
_CUT = 2.0


@dataclass(frozen=True, kw_only=True)
class Released:
    """What the released code does with a dataset: center, the name in `Item.centers`; centring, the same in words; crop
    in words; split: the name that prepare must have split by; least: points of people whom it judges; without: joints
    that it leaves out of its means."""

    center: str
    centring: str
    crop: str
    split: str
    least: int = 1
    without: tuple[str, ...] = ()


RELEASED = {
    "waymo": Released(
        center="box", centring="labelled box (oracle)", crop="points in the labelled box", split="official"
    ),
    "humanm3": Released(
        center="joints_box",
        centring="box of the true joints (oracle)",
        crop="points in the box of the true joints, 1.25 times as large",
        split="official",
        without=("pelvis",),
    ),
    "lidarhuman26m": Released(
        center="trans", centring="SMPL trans (oracle)", crop="people as the dataset segmented them", split="official"
    ),
    "sloper4d": Released(
        center="trans",
        centring="SMPL trans (oracle)",
        crop="people as the dataset segmented them",
        split="dapt",
        least=10,
    ),
}

POINTS = "points alone"
_CLEAN_CROPS = {
    "waymo": "labelled box with a detector's errors",
    "humanm3": "box about the true joints with a detector's errors",
    "bench": "the set's own detector's box",
    "synth": "the set's own detector's box",
}
# sets whose crops are a detector's already
_OWN_CROP = ("bench", "synth")
_SEGMENTED = "people as the dataset segmented them: there is no box, so none could be displaced"


def check_protocol(protocol: str, kind: str, split_by: str | None, name: str) -> None:
    """Raises InputError, one line, where the dataset cannot be judged by the protocol. kind: the raw dataset's name,
    "synth" or "bench"; split_by: the split it was prepared with; name: what to call it."""
    check_name("protocol", protocol, PROTOCOLS)
    if protocol == "clean":
        if split_by == "dapt":
            raise InputError(
                f"{name} was split by dapt, where neighbouring frames are in train and test: use --protocol dapt, or "
                f"run lidarpose prepare {kind} RAW OUT again without --split-by dapt"
            )
        return
    if kind in _OWN_CROP:
        raise InputError(
            f"the protocol dapt centers on labels of real datasets, {name} is synthetic: use --protocol clean"
        )
    if kind not in RELEASED:
        raise InputError(
            f"the released code evaluates {', '.join(RELEASED)}, not {kind}: use --protocol clean for {name}"
        )
    wanted = RELEASED[kind].split
    if split_by != wanted:
        raise InputError(
            f"{name} was split by {split_by or 'nothing'}, the protocol dapt is by {wanted}: run lidarpose prepare "
            f"{kind} RAW OUT --split-by {wanted} into another folder"
        )


def centring(protocol: str, kind: str) -> str:
    """What the center is found from, in words."""
    return POINTS if protocol == "clean" else RELEASED[kind].centring


def crop(protocol: str, kind: str) -> str:
    """How the person was cut out, in words."""
    return _CLEAN_CROPS.get(kind, _SEGMENTED) if protocol == "clean" else RELEASED[kind].crop


def jittered(box: Box, rng: np.random.Generator) -> Box:
    """The box as a detector might have drawn it: its center off by 10 cm (5 cm in height), its edges by 5 %, its yaw by
    0.1 rad, standard deviations of normal errors cut at twice that."""
    step = np.clip(rng.standard_normal(7), -_CUT, _CUT)
    shift = step[:3] * [CENTER_SIGMA, CENTER_SIGMA, HEIGHT_SIGMA]
    return replace(
        box,
        center=box.center + shift,
        size=box.size * np.exp(SIZE_SIGMA * step[3:6]),
        yaw=float(box.yaw + YAW_SIGMA * step[6]),
    )


def detector_box(kind: str, person: Person, seed: int) -> Box | None:
    """The displaced box that a person of a real dataset is cut out by in the protocol clean; None where they come as
    they are. Whoever else is judged, it is the same."""
    if kind in _OWN_CROP or kind not in _CLEAN_CROPS or person.box is None:
        return None
    return jittered(person.box, np.random.default_rng([seed, person.shard, person.row]))


def cropped(protocol: str, kind: str, person: Person, seed: int) -> Person:
    """The person with the points that the protocol lets the network see."""
    if protocol == "dapt":
        kept, _ = released_view(person.points, person.joints, person.centers, person.box)
        return replace(person, points=person.points[kept])
    box = detector_box(kind, person, seed)
    return person if box is None else replace(person, points=person.points[box.contains(person.points)])


def released_center(kind: str, person: Person) -> np.ndarray | None:
    """(3,) m: what the released code subtracts; None where the dataset has none for this person."""
    return person.centers.get(RELEASED[kind].center)
