"""Corpora of simulated and captured people that LiDAR pose papers pre-train on: LIPD, FreeMotion, NoiseMotion.

    lipd            *.pkl: a list of dicts seq_path, pc (n, 3) m or a path of float32, gt_joint (24, 3) m, trans
    freemotion      *.pkl: a list of dicts motion_id or seq_path, gt (72) rad, shape (10), and of up to three LiDARs
                    pc_1 ... (or pc) and T_1 ...: the points, m, and the pelvis in their frame
    noisemotion     the .pkl that the authors' dataloader_NoiseMotion.py makes of it and of SURREAL's poses: as
                    freemotion, with gt (3, 72) and shape (3, 10)

Sources: 4DVLab/LIP dataset/LIP_dataset.py, 4DVLab/LiveHPS dataset/Livehps_dataset.py and test.py, 4DVLab/LiveHPS2.
Pickles are read without running them.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lidarpose.data.readers.base import Skipped, as_cloud, find_below, numbers, read_cloud, wrong_root
from lidarpose.data.readers.smpl_joints import SmplJoints, smpl_item
from lidarpose.errors import InputError
from lidarpose.io.files import file_error
from lidarpose.io.pickles import load_pickle
from lidarpose.sample import LabeledSample
from lidarpose.skeleton import SMPL24

# points are this close to the nearest joint in the median where labels and clouds fit, m: a trunk is 0.2 m thick
_NEAR = 0.35
_FPS = 10.0


class _Corpus(ABC):
    """Pickles of lists of dicts. A part is a file."""

    name = ""
    skeleton = SMPL24.name
    get = ""
    about: dict

    def parts(self, root: Path) -> list[str]:
        """The pickles of the root. Raises InputError where there are none."""
        found = sorted(path.name for path in root.glob("*.pkl"))
        if not found:
            there = ", ".join(sorted(path.name for path in root.iterdir())[:6]) or "nothing"
            raise wrong_root(root, self.name, "a folder of its .pkl files", f"got {there}", self.get)
        return found

    def read(self, root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
        """Everybody in a file, in its order."""
        content = load_pickle(root / part)
        if not isinstance(content, list):
            raise file_error(root / part, f"expected {self.name}'s list of dicts, got {type(content).__name__}")
        counts: dict[str, int] = {}
        for number, entry in enumerate(content):
            where = f"{part}: entry {number}"
            if not isinstance(entry, dict):
                yield Skipped(reason="entry of another form", where=f"{where}: {type(entry).__name__}")
                continue
            sequence = str(entry.get("seq_path", entry.get("motion_id", part)))
            frame = counts[sequence] = counts.get(sequence, -1) + 1
            yield from self._entry(root, entry, where, f"{part}/{sequence}", frame)

    @abstractmethod
    def _entry(
        self, root: Path, entry: dict, where: str, sequence: str, frame: int
    ) -> Iterator[LabeledSample | Skipped]:
        """Everybody in an entry."""

    def _item(
        self, points: np.ndarray, joints: np.ndarray, where: str, sequence: str, frame: int, track: str, source: str
    ) -> LabeledSample | Skipped:
        if not len(points):
            return Skipped(reason="empty cloud", where=where)
        if _apart(points, joints) > _NEAR:
            return Skipped(reason="joints are not where the points are", where=where)
        return smpl_item(
            points,
            joints,
            sequence=sequence,
            frame=frame,
            frame_id=f"{sequence}/{frame}",
            track=track,
            time=frame / _FPS,
            source=source,
            centers={},
            sensor_known=self.about.get("sensor_known", True),
        )


class Lipd(_Corpus):
    """LIPD (LIP, Ren et al. 2023). Its joints are relative; where they go is found by which way fits the points."""

    name = "lipd"
    get = "github.com/4DVLab/LIP (Google Drive)"
    about = {
        "frame": "as in the files, which do not say it",
        "sensor_known": False,
        "licence": "asked for where it is downloaded; the authors' code is Apache-2.0",
        "get": get,
        "notes": [
            "gt_joint is relative, and only some files say where (trans). Each entry is placed as gt_joint + trans, "
            "as that + the mean of the points, or as gt_joint alone, whichever is nearest to the points; source tells "
            "which. Entries without trans mostly fit none and are skipped.",
            "Paths of clouds are those of the authors' machine: the longest end of a path that is in the root is read.",
        ],
    }

    def _entry(
        self, root: Path, entry: dict, where: str, sequence: str, frame: int
    ) -> Iterator[LabeledSample | Skipped]:
        try:
            joints = numbers(where, entry["gt_joint"], (24, 3), "gt_joint")
            points = _points(root, entry["pc"], where)
            placed = {"gt_joint": joints}
            if entry.get("trans") is not None:
                trans = numbers(where, entry["trans"], (3,), "trans")
                middle = points.mean(0) if len(points) else 0.0
                placed |= {"gt_joint + trans": joints + trans, "gt_joint + trans + mean": joints + trans + middle}
        except KeyError as error:
            yield Skipped(reason=f"no {error.args[0]}", where=where)
            return
        except InputError as error:
            yield Skipped(reason="entry of another form", where=str(error))
            return
        best = min(placed, key=lambda name: _apart(points, placed[name]) if len(points) else 0.0)
        yield self._item(points, placed[best], where, sequence, frame, "0", f"lipd/{best}")


class FreeMotion(_Corpus):
    """FreeMotion (LiveHPS, Ren et al. 2024). Each person is seen by up to three LiDARs: an item for each."""

    name = "freemotion"
    get = "github.com/4DVLab/LiveHPS (Google Drive)"
    # frames of poses in an entry, and which one belongs to the points
    _poses, _which = 1, 0

    def __init__(self, *, smpl: str | Path | None = None):
        self._smpl = SmplJoints(smpl, self.name)
        self.about = {
            "frame": "of each LiDAR as in the files; the turns rot1 and rot2 of the authors' loader are left out",
            "settings": {"smpl": self._smpl.digests[self._smpl.kind("neutral")]},
            "licence": "asked for where it is downloaded",
            "get": self.get,
            "notes": [
                "T_1, T_2, T_3 are where the pelvis is, not SMPL's trans; shape gives betas, neutral body.",
                "Track 1, 2, 3 is the LiDAR that saw the person.",
            ],
        }

    def _entry(
        self, root: Path, entry: dict, where: str, sequence: str, frame: int
    ) -> Iterator[LabeledSample | Skipped]:
        try:
            pose = numbers(where, entry["gt"], (self._poses, 72), "gt")[self._which]
            betas = numbers(where, entry["shape"], (self._poses, 10), "shape")[self._which]
        except KeyError as error:
            yield Skipped(reason=f"no {error.args[0]}", where=where)
            return
        except InputError as error:
            yield Skipped(reason="entry of another form", where=str(error))
            return
        joints = self._smpl(betas[None], pose[None], np.zeros((1, 3)))[0]
        for view in (1, 2, 3):
            cloud = entry.get(f"pc_{view}", entry.get("pc") if view == 1 else None)
            if cloud is None:
                continue
            if entry.get(f"T_{view}") is None:
                yield Skipped(reason=f"no T_{view}", where=where)
                continue
            try:
                points = _points(root, cloud, where)
                pelvis = numbers(where, entry[f"T_{view}"], (3,), f"T_{view}")
            except InputError as error:
                yield Skipped(reason="entry of another form", where=str(error))
                continue
            yield self._item(points, joints - joints[0] + pelvis, where, sequence, frame, str(view), self.name)


class NoiseMotion(FreeMotion):
    """NoiseMotion (LiveHPS++, Ren et al. 2024), made of SURREAL's poses: three frames of them to a cloud."""

    name = "noisemotion"
    get = "github.com/4DVLab/LiveHPS2, and SURREAL (its own licence) at www.di.ens.fr/willow/research/surreal"
    # the files do not say which of the three the points belong to; the middle one is 33 ms off at most
    _poses, _which = 3, 1

    def __init__(self, *, smpl: str | Path | None = None):
        super().__init__(smpl=smpl)
        self.about["notes"] = [
            *self.about["notes"],
            "Three poses belong to a cloud, at 30 Hz; which one is not told. The middle one is taken.",
        ]

    def parts(self, root: Path) -> list[str]:
        """The pickles. Raises InputError where there are only the raw clouds, which have no poses."""
        if not any(root.glob("*.pkl")) and any(root.glob("pc_[123]")):
            raise file_error(
                root, "has clouds without poses, those are SURREAL's: run the authors' dataloader_NoiseMotion.py over "
                f"both and give the folder of its .pkl; get them at {self.get}",
            )  # fmt: skip
        return super().parts(root)


def _points(root: Path, value: object, where: str) -> np.ndarray:
    """(n, 3) of an array or of a file's path."""
    if isinstance(value, str):
        path = find_below(root, value)
        if path is None:
            raise InputError(f"{where}: the cloud {value} is not in {root}: copy it there")
        if path.suffix == ".bin":
            try:
                return as_cloud(path, np.fromfile(path, "<f4"))
            except OSError as error:
                raise file_error(path, f"cannot be read ({error.strerror or error})") from None
        return read_cloud(path)
    return as_cloud(where, value)


def _apart(points: np.ndarray, joints: np.ndarray) -> float:
    """The median distance of the points to the nearest joint, m."""
    return float(np.median(np.linalg.norm(points[:, None] - joints, axis=-1).min(1)))
