"""Backends, which run a network: from people's points to raw outputs as arrays. This file does not need torch.

Legend: B people, J joints, W bins of a heatmap.

A backend has a `name`, the network's `header`, `batch` (people per call) and `run(clouds, view)`. There are two: ONNX
Runtime, in this file, and torch (`torch_backend`).
"""

import os
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Protocol, cast

import numpy as np

from lidarpose.errors import InputError
from lidarpose.io.files import content_digest, file_error
from lidarpose.models import weights_file
from lidarpose.models.checkpoint import Header, read_header
from lidarpose.models.config import BIN, NetworkConfig
from lidarpose.models.decode import Decoder, out_of_range, sigmoid
from lidarpose.models.onnx import input_name, map_in_threads, open_onnx, output_names, thread_count, voxelize_people
from lidarpose.sample import CONFIDENCE_RADIUS, PER_PERSON, Pose
from lidarpose.skeleton import Skeleton

# people per call, and people per run of the network: the activations of more do not fit in the processor's cache
_BATCH, _PART = 64, 8
# log of the largest reported spread, m: the spread of an untrained network is unbounded
_LARGEST_LOG_SPREAD = 5.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Raw:
    """Raw outputs of a network in the person's frame, joints in the order of its skeleton.

    vote (B, J, 3) m: origin of the heatmaps; heatmaps: logits (B, J, W) for x, y and z, None for networks without
    heatmaps; low, step (3,) m: position of bin 0 relative to the vote and distance between bins, per axis. For networks
    with these outputs, else None: confidence (B, J): logit of an error under `CONFIDENCE_RADIUS`; log_spread (B, J):
    log of the expected error in m; visible (B, J): logit that the joint is visible; person (B, 2): logits that the
    cloud shows a person, and a second person.
    """

    vote: np.ndarray
    heatmaps: tuple[np.ndarray, ...] | None
    low: np.ndarray
    step: np.ndarray
    confidence: np.ndarray | None = None
    log_spread: np.ndarray | None = None
    visible: np.ndarray | None = None
    person: np.ndarray | None = None

    @classmethod
    def from_joints(cls, joints: np.ndarray) -> "Raw":
        """The outputs of a network that only predicts joints (B, J, 3) m."""
        return cls(vote=joints, heatmaps=None, low=np.zeros(3), step=np.ones(3))

    @classmethod
    def from_pose(cls, outputs: dict[str, np.ndarray]) -> "Raw":
        """The outputs of a `PoseNet`, given by name."""
        heatmap = outputs["heatmap"]
        bins = heatmap.shape[-1]
        return cls(
            vote=outputs["vote"],
            heatmaps=tuple(heatmap[:, :, axis] for axis in range(3)) if bins else None,
            # the position of a bin is its middle
            low=np.full(3, (0.5 - bins / 2) * BIN),
            step=np.full(3, BIN),
            confidence=outputs["confidence"],
            log_spread=outputs["log_spread"],
            visible=outputs["visible"],
            person=outputs.get("person"),
        )


class Backend(Protocol):
    """Runs a network.

    `run` takes clouds: B arrays (n, 3) m, each relative to its person's center, n = 0 is legal; view (B, 5): see
    `VoxelPyramid`. Backends of networks that read clips also have the attribute `frames`, and their `run` takes `clip`,
    an `inputs.Clips` of the clouds, relative to the same centers.
    """

    name: str
    header: Header
    batch: int

    def run(self, clouds: list[np.ndarray], view: np.ndarray) -> Raw: ...


class OnnxBackend:
    """Runs a file written by `lidarpose export` with ONNX Runtime on the CPU. threads: None for all usable threads.

    People are distributed over the threads: a network this small hardly gains from several threads per person.
    """

    name = "onnx"
    batch = _BATCH

    def __init__(self, path: str | os.PathLike, *, threads: int | None = None):
        self._opened = os.path.abspath(path), threads
        self.threads = thread_count(threads)
        self.session, self.header, self.source = open_onnx(path)
        self._config = cast(NetworkConfig, self.header.config)
        # body parts are not needed: ONNX Runtime does not compute outputs that are not requested
        self._outputs = [name for name in output_names(self._config) if name != "part"]

    def __reduce__(self) -> tuple:
        # a session cannot be pickled: another process opens the file again
        path, threads = self._opened
        return partial(OnnxBackend, path, threads=threads), ()

    def run(self, clouds: list[np.ndarray], view: np.ndarray) -> Raw:
        # clouds are sorted by size: start with the largest, so that no thread has to finish a large one at the end
        parts = [(clouds[rows], view[rows]) for rows in person_parts(len(clouds), self.threads)[::-1]]
        values = map_in_threads(self._run, parts, self.threads)[::-1]
        arrays = values[0] if len(values) == 1 else map(np.concatenate, zip(*values, strict=True))
        return Raw.from_pose(dict(zip(self._outputs, arrays, strict=True)))

    def _run(self, people: tuple[list[np.ndarray], np.ndarray]) -> list[np.ndarray]:
        inputs = voxelize_people(*people, self._config).arrays()
        return self.session.run(self._outputs, {input_name(name): array for name, array in inputs.items()})


def person_parts(count: int, threads: int) -> list[slice]:
    """Splits `count` people into slices that are run through the network together, the same number for each thread."""
    part_count = max(min(-(-count // (_PART * threads)) * threads, count), 1)
    ends = np.linspace(0, count, part_count + 1).astype(int).tolist()
    return [slice(low, high) for low, high in pairwise(ends)]


@cache
def bundled_backend(name: str) -> OnnxBackend:
    """The backend of a bundled network by name, on all usable threads; opened once and shared by all callers."""
    return OnnxBackend(weights_file(f"{name}.onnx"))


def exported_beside(path: str | os.PathLike, *, threads: int | None = None) -> OnnxBackend:
    """The backend of the .onnx file beside a checkpoint.

    Raises InputError if there is none, or if it was exported from other weights.
    """
    path = Path(path)
    header = read_header(path)
    if header.network != "pose":
        raise file_error(path, f"the network {header.network} does not run as ONNX: omit backend, or use torch")
    onnx_path = path.with_suffix(".onnx")
    hint = f"make it with `lidarpose export {path} --out {onnx_path}`, or use backend torch"
    if not onnx_path.is_file():
        raise file_error(path, f"ONNX Runtime needs {onnx_path.name} beside it, which does not exist: {hint}")
    backend = OnnxBackend(onnx_path, threads=threads)
    if backend.source != content_digest(path, expected="a checkpoint"):
        raise file_error(onnx_path, f"made from other weights than {path.name} beside it: {hint}")
    return backend


def estimates(raw: Raw, decoder: Decoder, skeleton: Skeleton) -> Pose:
    """Decodes raw outputs into poses of B people relative to their centers; `decoder` reads the heatmaps.

    Raises InputError if no joint is finite.
    """
    joints, in_range = raw.vote.astype(float), None
    if raw.heatmaps is not None:
        axes = zip(raw.heatmaps, raw.low, raw.step, strict=True)
        joints = joints + np.stack([decoder(heatmap, low=low, step=step) for heatmap, low, step in axes], -1)
        # the joint may lie beyond the heatmap on any axis
        in_range = ~np.any([out_of_range(heatmap) for heatmap in raw.heatmaps], axis=0)
    if joints.size and not np.isfinite(joints).any():
        raise InputError("the network predicts no finite joints: its weights are damaged, get the file again")
    confidence = None if raw.confidence is None else sigmoid(raw.confidence)
    spread = None if raw.log_spread is None else np.exp(np.minimum(raw.log_spread.astype(float), _LARGEST_LOG_SPREAD))
    if confidence is None and raw.heatmaps is not None:
        confidence, spread = _from_heatmaps(raw, raw.heatmaps, joints - raw.vote)
    per_person = {} if raw.person is None else dict(zip(PER_PERSON, sigmoid(raw.person).T, strict=True))
    return Pose(
        joints=joints,
        skeleton=skeleton,
        confidence=confidence,
        spread=spread,
        visible=None if raw.visible is None else sigmoid(raw.visible),
        in_range=in_range,
        **per_person,
    )


def _from_heatmaps(raw: Raw, heatmaps: tuple[np.ndarray, ...], offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Confidence and spread (B, J) for a network without these outputs, from its heatmaps around the joints at `offset`
    (B, J, 3) m from the vote.

    Confidence is the probability mass of the heatmaps within `CONFIDENCE_RADIUS` of the joint, with independent axes.
    Spread is the root mean square distance from the joint. Neither is calibrated.
    """
    share, mean_square = np.ones(offset.shape[:2]), np.zeros(offset.shape[:2])
    for axis, heatmap in enumerate(heatmaps):
        weight = np.exp(heatmap.astype(float) - heatmap.max(-1, keepdims=True))
        weight /= weight.sum(-1, keepdims=True)
        distance = raw.low[axis] + np.arange(heatmap.shape[-1]) * raw.step[axis] - offset[..., axis, None]
        share = share * np.clip((weight * (np.abs(distance) < CONFIDENCE_RADIUS)).sum(-1), 0, 1)
        mean_square = mean_square + (weight * distance**2).sum(-1)
    return share, np.sqrt(mean_square)
