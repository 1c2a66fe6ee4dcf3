"""`load` a network and `predict` poses of clouds: any number type, one or many, empty ones too."""

import os
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from lidarpose.errors import InputError, unknown_name
from lidarpose.infer.people import MIN_POINTS, as_origin, as_points, candidates, clean, unit_warning
from lidarpose.infer.results import PersonPose, Poses
from lidarpose.model.batch import Batch
from lidarpose.model.checkpoint import Header, load_checkpoint
from lidarpose.model.network import PoseNet
from lidarpose.model.plan import WINDOW, plan, view_features
from lidarpose.sample import Pose, center_of
from lidarpose.skeleton import skeleton as skeleton_of

BUNDLED = ("tiny",)
# people a forward pass
_BATCH = 64
# passes: the second is centered on the pelvis that the first one found
PASSES = 2


def bundled_path(name: str = "tiny") -> Path:
    """Where the package keeps a bundled checkpoint."""
    if name not in BUNDLED:
        raise unknown_name("bundled weights", name, BUNDLED)
    return Path(str(resources.files("lidarpose.model") / "weights" / f"{name}.safetensors"))


def load(weights: str | os.PathLike = "tiny", *, device: str = "cpu") -> "Predictor":
    """The bundled network, or the checkpoint at a path, ready to predict.

    Raises InputError for an unknown name, a file that is no checkpoint, or a device that is not there.
    """
    name = os.fspath(weights)
    is_path = not isinstance(weights, str) or "/" in name or name.endswith(".safetensors") or os.path.isfile(name)
    path = weights if is_path and name not in BUNDLED else bundled_path(name)
    network, header = load_checkpoint(path)
    try:
        return Predictor(network, header, name=Path(name).stem, device=device)
    except (RuntimeError, AssertionError) as error:
        # torch raises either for an unknown or a missing device
        reason = str(error).partition("\n")[0]
        raise InputError(
            f"device {device!r} cannot be used ({reason}); expected cpu, or cuda where torch has it"
        ) from None


class Predictor:
    """A network ready to use. `predict` is kind; `outputs` is raw."""

    def __init__(self, network: PoseNet, header: Header, *, name: str, device: str = "cpu"):
        self.network = network.to(device).eval()
        self.header = header
        self.device = device
        self.model = {"name": name, "version": header.version}

    def predict(
        self,
        points,
        *,
        sensor_origin: np.ndarray | tuple[float, float, float] | str | None = None,
        skeleton: str = "smpl24",
        progress: bool = False,
    ) -> PersonPose | Poses:
        """One cloud (n, 3+) -> `PersonPose`; a list of clouds -> `Poses`, in their order.

        points: x, y, z in metres, z up, any frame, each cloud one person, ground and clutter allowed; more columns are
        ignored. sensor_origin (3,) m: where the sensor stood in that frame, None or "unknown" if that is not known. A
        cloud of under 5 points gets a result without joints and a warning. Raises InputError for arrays of another
        shape or type.
        """
        wanted = skeleton_of(skeleton)
        self.network.skeleton.map_to(wanted)
        origin = as_origin(sensor_origin)
        if not _is_many(points):
            return self._people([as_points(points)], origin, wanted, False)[0]
        clouds = [as_points(cloud, f"points[{i}]") for i, cloud in enumerate(points)]
        people = self._people(clouds, origin, wanted, progress)
        return Poses(people=tuple(people), skeleton=wanted, model=self.model)

    def _people(self, clouds, origin, wanted, progress) -> list[PersonPose]:
        cleaned = [clean(cloud) for cloud in clouds]
        results = [
            PersonPose(pose=None, skeleton=wanted, points=points, warnings=tuple(notes), model=self.model)
            for points, notes in cleaned
        ]
        clouds, owner = [], []
        for i, (points, _) in enumerate(cleaned):
            if len(points) < MIN_POINTS:
                results[i] = _warned(results[i], f"no pose: under {MIN_POINTS} points")
                continue
            if warning := unit_warning(np.ptp(points, axis=0), what="the person"):
                results[i] = _warned(results[i], warning)
            found = candidates(points)
            clouds += found
            owner += [i] * len(found)
        best: dict[int, Pose] = {}
        starts = range(0, len(clouds), _BATCH)
        for start in tqdm(starts, unit=" batches", delay=1, disable=not progress, leave=False):
            part = slice(start, start + _BATCH)
            for i, pose in zip(owner[part], self._poses(clouds[part], origin), strict=True):
                if pose is not None and (i not in best or pose.confidence.mean() > best[i].confidence.mean()):
                    best[i] = pose
        for i in sorted(set(owner)):
            if i in best:
                results[i] = replace(results[i], pose=best[i].to(wanted))
            else:
                note = f"no pose: under {MIN_POINTS} points within {WINDOW:.0f} m of the person's middle"
                results[i] = _warned(results[i], note)
        return results

    def _poses(self, clouds: list[np.ndarray], origin: np.ndarray | None) -> list[Pose | None]:
        """The pose of each cloud (n, 3) m, None where too little of it is near its middle."""
        centers = np.stack([center_of(points) for points in clouds])
        pelvis = self.network.skeleton.index("pelvis")
        for last in range(PASSES):
            joints, confidence, spread = self.outputs(clouds, centers, origin)
            if last < PASSES - 1:
                centers = centers + np.clip(joints[:, pelvis], -WINDOW / 2, WINDOW / 2)
        poses = []
        for k, points in enumerate(clouds):
            near = (np.abs(points - centers[k]) < WINDOW).all(1).sum()
            pose = Pose(
                joints=joints[k] + centers[k],
                skeleton=self.network.skeleton,
                confidence=confidence[k],
                spread=spread[k],
            )
            poses.append(pose if near >= MIN_POINTS and np.isfinite(joints[k]).all() else None)
        return poses

    @torch.inference_mode()
    def outputs(
        self, clouds: list[np.ndarray], centers: np.ndarray, origin: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Joints (B, J, 3) m about centers (B, 3), confidence (B, J) and spread (B, J) m of clouds (n, 3) m."""
        tables = plan(
            np.concatenate([points - center for points, center in zip(clouds, centers, strict=True)]),
            np.array([len(points) for points in clouds]),
            grid=self.network.config.grid,
            max_voxels=self.network.config.max_voxels,
            view=np.stack([view_features(center, origin) for center in centers]),
        )
        out = self.network(Batch.from_plan(tables, self.device))
        return (
            out.joints().cpu().numpy().astype(float),
            out.confidence.sigmoid().cpu().numpy().astype(float),
            out.log_spread.exp().cpu().numpy().astype(float),
        )


def _is_many(points) -> bool:
    """A list of clouds, rather than one cloud, be it written as a list of rows."""
    if isinstance(points, list | tuple):
        return len(points) == 0 or not _is_row(points[0])
    return getattr(points, "ndim", 0) == 3


def _is_row(value) -> bool:
    """One point: a flat list or array. Anything ragged is none."""
    if isinstance(value, list | tuple):
        return not any(isinstance(entry, list | tuple) or getattr(entry, "ndim", 0) for entry in value)
    return getattr(value, "ndim", 0) == 1


def _warned(person: PersonPose, warning: str) -> PersonPose:
    return replace(person, warnings=(*person.warnings, warning))
