"""Configurations of the baselines, and the conversion of clouds to the inputs of their networks. Numpy only.

Legend: B people, N points of the largest cloud.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from lidarpose.errors import InputError
from lidarpose.models.config import Config, check_joints, probability
from lidarpose.models.voxelize import WINDOW
from lidarpose.sample import CLIP_FRAMES
from lidarpose.skeleton import HUMAN15, SMPL24

# maximum number of points of a person that a network reads, as published
MOST_POINTS = 1024
GRIDS = (64, 32, 16)
# allowed divisors of widths; the numbers of attention heads and groups stay the same
DIVISORS = (1, 2, 4, 8)


@dataclass(frozen=True, kw_only=True)
class BaselineConfig(Config):
    """The settings of all baselines.

    frames: of a clip, 1 for networks of single frames; min_tensors: a lower bound of the number of its tensors; joints:
    names, in the order of the outputs; width_divisor: number by which the published channels of hidden layers are
    divided, for CPUs; most_points: of a cloud, larger clouds are subsampled. Each option is False for the corrected
    behavior. Raises InputError for unknown joints, other divisors, and options that are not booleans.
    """

    frames: ClassVar[int] = 1
    min_tensors: ClassVar[int] = 1

    joints: tuple[str, ...] = HUMAN15.joints
    width_divisor: int = 1
    most_points: int = MOST_POINTS

    def __post_init__(self):
        super().__post_init__()
        check_joints(self.joints)
        if self.width_divisor not in DIVISORS:
            divisors = ", ".join(map(str, DIVISORS))
            raise InputError(f"width_divisor must be one of {divisors}, got {self.width_divisor!r}")

    @property
    def name(self) -> str:
        return self.kind


@dataclass(frozen=True, kw_only=True)
class PrnConfig(BaselineConfig):
    """PRN, the pose network of LiDAR-HMR.

    resample_with_replacement: `most_points` points are drawn, some of them several times, in evaluation too, as
    published; else each point is used once, and larger clouds are subsampled to that number; missing_in_softmax: a
    neighbor that is missing in a small cloud takes part in the attention's batch norms and softmax, and its weight is
    set to 0 afterwards, as published; labels_before_scaling: in training, the part labels of points are those of the
    person before the augmentation scales it, as published; attention_dropout: share of the attention's weights that are
    dropped.
    """

    kind: ClassVar[str] = "prn"
    min_tensors: ClassVar[int] = 100

    resample_with_replacement: bool = False
    missing_in_softmax: bool = False
    labels_before_scaling: bool = False
    attention_dropout: float = probability(0.1)


@dataclass(frozen=True, kw_only=True)
class LpformerConfig(BaselineConfig):
    """LPFormer for crops.

    resample_with_replacement: as for `PrnConfig`; grid: cells per side of the occupancy grid, 64 as published, or 32 or
    16, each an eighth of the work of the one before, with weights of the same shapes; labels_before_scaling: as for
    `PrnConfig`; second_softmax: the cross entropy of parts is computed from probabilities, as published;
    divide_by_all_joints: the distance of joints is divided by the number of all joints, labeled or not, as published;
    sensor_position: a point's token has its position relative to the sensor beside the local one, as in LiDAR-HMR, else
    the local one twice, as in the DAPT repository; attention_dropout: share of the attention's weights that are
    dropped.
    """

    kind: ClassVar[str] = "lpformer"
    min_tensors: ClassVar[int] = 50

    grid: int = 64
    resample_with_replacement: bool = False
    attention_dropout: float = probability(0.1)
    labels_before_scaling: bool = False
    second_softmax: bool = False
    divide_by_all_joints: bool = False
    sensor_position: bool = False

    def __post_init__(self):
        super().__post_init__()
        if self.grid not in GRIDS:
            raise InputError(f"grid must be {', '.join(map(str, GRIDS))} cells, got {self.grid!r}")


def pad_clouds(
    clouds: list[np.ndarray], view: np.ndarray, config: PrnConfig | LpformerConfig, seeds: list[int]
) -> dict[str, np.ndarray]:
    """Clouds (n, 3) m of people, where n may be 0, as inputs of a network of single frames.

    Args:
        clouds: each in its person's frame; points beyond `WINDOW` are left out.
        view: (B, 5), see `voxelize.view_features`.
        config: of the network, with the number of points and how they are drawn.
        seeds: of the random draws, one number per person.

    Returns:
        points (B, N, 3) float32 m, relative to the middle of the cloud's extent; valid (B, N) bool, False for padding;
        middle (B, 3) float32 m in the person's frame; center (B, 3) float32 m: the middle relative to the sensor, 0 if
        the sensor position is unknown.
    """
    centered_clouds, middles, most_points = [], [], config.most_points
    for cloud, seed in zip(clouds, seeds, strict=True):
        crop = _near(cloud, WINDOW)
        rng = np.random.default_rng(seed)
        middles.append((crop.min(0) + crop.max(0)) / 2)
        if config.resample_with_replacement:
            extra_rows = rng.integers(len(crop), size=most_points - len(crop) * (len(crop) <= most_points))
            rows = extra_rows if len(crop) > most_points else np.concatenate([np.arange(len(crop)), extra_rows])
            crop = crop[rows]
        elif len(crop) > most_points:
            crop = crop[rng.choice(len(crop), most_points, replace=False)]
        centered_clouds.append(crop - middles[-1])
    middle = np.stack(middles)
    direction, distance, has_sensor = view[:, :3], np.exp(view[:, 3:4]), view[:, 4:] > 0
    points, valid = _padded(centered_clouds)
    center = np.where(has_sensor, middle - direction * distance, 0)
    centers = {"middle": middle.astype(np.float32), "center": center.astype(np.float32)}
    return {"points": points, "valid": valid, **centers}


# ---- networks of clips

# clouds of a frame by name: the person, the static surroundings, and the frame's other points
CLOUDS = ("person", "background", "neighbors")
# maximum number of points of each cloud that a network of clips reads, as published
FRAME_POINTS = 512


@dataclass(frozen=True, kw_only=True)
class LidarcapConfig(BaselineConfig):
    """LiDARCap.

    resample_with_replacement: every cloud has `most_points` points: smaller clouds are repeated in full, larger ones
    are drawn from with replacement, as published; else each point is used once; order_dependent_neighbors:
    neighborhoods depend on the order of the points, as in its CUDA kernels, and centers that repeat in small clouds
    count in batch norms; trans_center: in training, frames are centered on SMPL's true trans, as published, so that the
    network need not learn where the pelvis is; else on the points, or on an estimate of the pelvis;
    normalize_in_training: in training, the points of a frame are centered horizontally on their mean, vertically on
    that of the clip, and divided by 1.2, as in the published training code; evaluation does none of this, as published;
    stock_initialization: weights are initialized as by PyTorch's layers, as published; else rotations start near the
    identity, and the layers of NE's encoders start as copies of their inputs.
    """

    kind: ClassVar[str] = "lidarcap"
    frames: ClassVar[int] = CLIP_FRAMES
    min_tensors: ClassVar[int] = 50
    clouds: ClassVar[tuple[str, ...]] = CLOUDS[:1]

    joints: tuple[str, ...] = SMPL24.joints
    most_points: int = FRAME_POINTS
    resample_with_replacement: bool = False
    order_dependent_neighbors: bool = False
    trans_center: bool = False
    normalize_in_training: bool = False
    stock_initialization: bool = False

    def __post_init__(self):
        super().__post_init__()
        if self.joints != SMPL24.joints:
            raise InputError(f"the joints of {self.kind} are SMPL's 24, got {', '.join(self.joints)}")


@dataclass(frozen=True, kw_only=True)
class NeConfig(LidarcapConfig):
    """NE.

    exchange_across_batch: the exchange among the three clouds attends over the clips of a batch instead of the frames
    of a clip, as published; with one clip, each frame then attends only to itself.
    """

    kind: ClassVar[str] = "ne"
    clouds: ClassVar[tuple[str, ...]] = CLOUDS

    exchange_across_batch: bool = False

    def __post_init__(self):
        super().__post_init__()
        if self.normalize_in_training:
            raise InputError("normalize_in_training is an option of lidarcap, whose one cloud has no others about it")


def pad_frames(
    clouds: list[np.ndarray], config: LidarcapConfig, seeds: list[int], *, window: float = np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Clouds (n, 3) m of frames, where n may be 0, relative to their centers, as inputs of a network of clips.

    Args:
        clouds: of F frames.
        config: of the network, with the number of points and how they are drawn.
        seeds: of the random draws, one number per frame.
        window: points farther than this from the center along an axis are left out, m.

    Returns:
        Points (F, N, 3) float32 m and valid (F, N) bool, False for padding.
    """
    frame_clouds, most_points, with_replacement = [], config.most_points, config.resample_with_replacement
    for cloud, seed in zip(clouds, seeds, strict=True):
        crop = _near(cloud, window)
        if len(crop) > most_points:
            crop = crop[np.random.default_rng(seed).choice(len(crop), most_points, replace=with_replacement)]
        frame_clouds.append(_repeated(crop, most_points) if with_replacement else crop)
    return _padded(frame_clouds)


def _repeated(points: np.ndarray, count: int) -> np.ndarray:
    """Repeats points (n, 3) to `count` points: all equally often, each in succession, then the first of these again.

    Source: LiDARCap's fix_points_num.
    """
    copies = np.repeat(points, count // len(points), axis=0)
    return np.concatenate([copies, copies[: count - len(copies)]])


def _near(cloud: np.ndarray, window: float) -> np.ndarray:
    """The points (n, 3) within `window` m of the origin along each axis; the origin itself if there are none."""
    points = cloud[(np.abs(cloud) < window).all(1)]
    return points if len(points) else np.zeros((1, 3))


def _padded(clouds: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Clouds (n, 3) as points (B, N, 3) float32 and valid (B, N) bool, False for padding."""
    points = np.zeros((len(clouds), max(map(len, clouds)), 3), np.float32)
    valid = np.zeros(points.shape[:2], bool)
    for row, cloud in enumerate(clouds):
        points[row, : len(cloud)], valid[row, : len(cloud)] = cloud, True
    return points, valid
