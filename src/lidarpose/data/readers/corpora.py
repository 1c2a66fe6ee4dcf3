"""Corpora of simulated and captured people that LiDAR pose papers pre-train on: LIPD, FreeMotion, NoiseMotion.

    lipd            *.pkl: a list of dicts seq_path, pc (n, 3) m or a path of float32, gt_joint (24, 3) m, trans
    freemotion      *.pkl: a list of dicts motion_id or seq_path, gt (72) rad, shape (10), and for up to three LiDARs
                    pc_1 ... (or pc) and T_1 ...: the points, m, and the pelvis, along the first LiDAR's axes
                    about each LiDAR
    noisemotion     the .pkl that the authors' dataloader_NoiseMotion.py makes from the raw clouds and SURREAL's poses:
                    like freemotion, with gt (3, 72) and shape (3, 10)

Sources: 4DVLab/LIP dataset/LIP_dataset.py, 4DVLab/LiveHPS dataset/Livehps_dataset.py and test.py, 4DVLab/LiveHPS2.
Pickles are read without running them.
"""

import collections
from abc import abstractmethod
from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.data.readers import base
from lidarpose.data.readers.base import Reader, Skipped, SmplJoints
from lidarpose.errors import InputError
from lidarpose.io.files import file_error, unreadable
from lidarpose.io.pickles import load_pickle
from lidarpose.sample import LabeledSample
from lidarpose.skeleton import SMPL24

# if labels and cloud fit, the median distance of points to the nearest joint is below this, m: a trunk is 0.2 m thick
_NEAR = 0.35
_FPS = 10.0


@dataclass(frozen=True)
class _Entry:
    """A dict of a corpus, with its location for messages, its sequence and its frame."""

    content: dict
    root: Path
    where: str
    sequence: str
    frame: int

    def numbers(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        return base.numbers(self.where, self.content[name], shape, name)

    def points(self, name: str) -> np.ndarray:
        """Points (n, 3) of an array or of the file at a path."""
        value = self.content[name]
        if not isinstance(value, str):
            return base.as_cloud(self.where, value)
        path = base.find_below(self.root, value)
        if path is None:
            raise InputError(f"{self.where}: the cloud {value} is not in {self.root}: copy it there")
        if path.suffix != ".bin":
            return base.read_cloud(path)
        try:
            return base.as_cloud(path, np.fromfile(path, "<f4"))
        except OSError as error:
            raise unreadable(path, error) from None

    def sample(self, points: np.ndarray, joints: np.ndarray, **labels: Any) -> LabeledSample | Skipped:
        """The entry's sample. labels: track, source and other fields of a `LabeledSample`."""
        if not len(points):
            return Skipped("empty cloud", self.where)
        if _apart(points, joints) > _NEAR:
            return Skipped("joints are far from the points", self.where)
        frame_labels: dict[str, Any] = {"sequence": self.sequence, "frame": self.frame, "time": self.frame / _FPS}
        return base.labeled_sample(points, joints, **frame_labels, **labels)


class _Corpus(Reader):
    """Reads pickles of lists of dicts. A part is a file."""

    skeleton = SMPL24.name

    def parts(self, root: Path) -> list[str]:
        """The pickles in the root. Raises InputError if there are none."""
        names = sorted(path.name for path in root.glob("*.pkl"))
        if not names:
            raise self.wrong_root(root)
        return names

    def read(self, root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
        """All people of a file, in its order."""
        content = load_pickle(root / part)
        if not isinstance(content, list):
            raise file_error(root / part, f"expected {self.name}'s list of dicts, got {type(content).__name__}")
        counts: dict[str, int] = {}
        for number, entry in enumerate(content):
            where = f"{part}: entry {number}"
            if not isinstance(entry, dict):
                yield Skipped("entry in another format", f"{where}: {type(entry).__name__}")
                continue
            sequence = str(entry.get("seq_path", entry.get("motion_id", part)))
            frame = counts[sequence] = counts.get(sequence, -1) + 1
            try:
                yield from self._entry(_Entry(entry, root, where, f"{part}/{sequence}", frame))
            except KeyError as error:
                yield Skipped(f"no {error.args[0]}", where)
            except InputError as error:
                yield Skipped("entry in another format", str(error))

    @abstractmethod
    def _entry(self, entry: _Entry) -> Iterator[LabeledSample | Skipped]:
        """All people of an entry. Raises KeyError if something is missing, InputError if it has another form."""


class Lipd(_Corpus):
    """LIPD (LIP, Ren et al. 2023). Its joints are relative; they are placed in the way that fits the points best."""

    name = "lipd"

    def _entry(self, entry: _Entry) -> Iterator[LabeledSample | Skipped]:
        joints, points = entry.numbers("gt_joint", (24, 3)), entry.points("pc")
        candidates = {"gt_joint": joints}
        if entry.content.get("trans") is not None:
            trans = entry.numbers("trans", (3,))
            mean_point = points.mean(0) if len(points) else 0.0
            candidates |= {"gt_joint + trans": joints + trans, "gt_joint + trans + mean": joints + trans + mean_point}
        best_name = _nearest(points, candidates)
        yield entry.sample(points, candidates[best_name], track="0", source=f"lipd/{best_name}", sensor_known=False)


class FreeMotion(_Corpus):
    """FreeMotion (LiveHPS, Ren et al. 2024). Up to three LiDARs see each person; each gives a sample."""

    name = "freemotion"
    # number of poses in an entry, and the index of the one that belongs to the points
    _poses, _which = 1, 0

    def __init__(self, *, smpl: str | Path | None = None):
        self._smpl = SmplJoints(smpl, self.name)
        super().__init__(smpl=self._smpl.digests[self._smpl.kind("neutral")])

    def _entry(self, entry: _Entry) -> Iterator[LabeledSample | Skipped]:
        pose = entry.numbers("gt", (self._poses, 72))[self._which]
        has_shape = entry.content.get("shape") is not None
        betas = entry.numbers("shape", (self._poses, 10))[self._which] if has_shape else np.zeros(10)
        source = self.name if has_shape else f"{self.name}/mean shape"
        joints = self._smpl(betas[None], pose[None], np.zeros((1, 3)))[0]
        if all(entry.content.get(name) is None for name in ("pc", "pc_1", "pc_2", "pc_3")):
            yield Skipped("no pc", entry.where)
        for view in (1, 2, 3):
            cloud = "pc" if view == 1 and entry.content.get("pc_1") is None else f"pc_{view}"
            if entry.content.get(cloud) is None:
                continue
            if entry.content.get(f"T_{view}") is None:
                yield Skipped(f"no T_{view}", entry.where)
                continue
            try:
                points, position = entry.points(cloud), entry.numbers(f"T_{view}", (3,))
            except InputError as error:
                yield Skipped("entry in another format", str(error))
                continue
            placed, words = self._place(points, joints, position)
            yield entry.sample(points, placed, track=str(view), source=source + words)

    def _place(self, points: np.ndarray, joints: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, str]:
        """Joints (24, 3), of SMPL with trans 0, at a LiDAR's T, and what to add to the source."""
        return joints - joints[0] + position, ""


class NoiseMotion(FreeMotion):
    """NoiseMotion (LiveHPS++, Ren et al. 2024), made from SURREAL's poses: three frames of poses per cloud."""

    name = "noisemotion"
    # the files do not say which of the three poses belongs to the points; the middle one is off by at most 33 ms
    _poses, _which = 3, 1
    # what T is in the file that is read, "" if it has no points; while it is None, the distances of the points, m, by
    # what T may be are collected
    _meaning: str | None = None
    _distances: dict[str, list[float]]

    def read(self, root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
        """The script writes SURREAL's trans, LiveHPS's loader expects the pelvis: whichever is nearer to the points of
        a file's people in the median."""
        reader = copy(self)
        reader._distances = {}
        # read once for the distances
        collections.deque(super(NoiseMotion, reader).read(root, part), maxlen=0)
        medians = {meaning: np.median(distances) for meaning, distances in reader._distances.items()}
        reader._meaning = min(medians, key=medians.__getitem__, default="")
        yield from super(NoiseMotion, reader).read(root, part)

    def _place(self, points: np.ndarray, joints: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, str]:
        candidates = {"T is the pelvis": joints - joints[0] + position, "T is trans": joints + position}
        if self._meaning is None and len(points):
            for meaning, placed in candidates.items():
                self._distances.setdefault(meaning, []).append(_apart(points, placed))
        meaning = self._meaning or next(iter(candidates))
        return candidates[meaning], f"/{meaning}"

    def parts(self, root: Path) -> list[str]:
        """The pickles. Raises InputError if there are only raw clouds, which have no poses."""
        if not any(root.glob("*.pkl")) and any(root.glob("pc_[123]")):
            problem = "has clouds without poses, which are in SURREAL: run the authors' dataloader_NoiseMotion.py on "
            raise file_error(root, f"{problem}both and give the folder of its .pkl; get them at {self.about['get']}")
        return super().parts(root)


def _nearest(points: np.ndarray, candidates: dict[str, np.ndarray]) -> str:
    """The name of the joints (24, 3) nearest to the points; the first if there are none."""
    return min(candidates, key=lambda name: _apart(points, candidates[name]) if len(points) else 0.0)


def _apart(points: np.ndarray, joints: np.ndarray) -> float:
    """The median distance of points to their nearest joint, m."""
    return float(np.median(np.linalg.norm(points[:, None] - joints, axis=-1).min(1)))
