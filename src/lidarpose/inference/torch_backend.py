"""Backends that run networks with torch, on any device, including the paper's network and its baselines."""

import os
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import nn

from lidarpose.errors import InputError
from lidarpose.inference.backend import Backend, Raw
from lidarpose.inference.inputs import Clips
from lidarpose.models import NETWORKS
from lidarpose.models.baselines.baseline_config import pad_clouds, pad_frames
from lidarpose.models.checkpoint import Header, load_checkpoint
from lidarpose.models.onnx import output_names, voxelize_people
from lidarpose.models.posenet import ArrayModule, PoseNet
from lidarpose.models.voxelize import WINDOW
from lidarpose.sample import CLIP_FRAMES
from lidarpose.skeleton import SMPL24

# people per call, on the CPU, on accelerators, and for the paper's network and its baselines, which are a hundred times
# as large: on the CPU, the activations of more do not fit in the cache, while accelerators need more
_CPU_BATCH, _BATCH, _SLOW_BATCH = 16, 64, 8


def torch_backend(path: str | os.PathLike, *, device: str = "cpu", compile: bool = False) -> Backend:
    """The torch backend of a checkpoint. compile: use `torch.compile`, which takes about a minute at the first call.

    Raises InputError for a file that is not a checkpoint, or a device that is not available.
    """
    network, header = load_checkpoint(path)
    try:
        network.to(device)
        # no data can be read back from the device "meta"
        torch.zeros(1, device=device).cpu()
    except (RuntimeError, AssertionError) as error:
        # for an unknown or missing device torch raises one of these, or NotImplementedError, a RuntimeError
        reason = str(error).partition("\n")[0]
        # torch lists all of its devices
        reason = "torch has no such device" if reason.startswith("Expected one of") else reason
        raise InputError(
            f"device {device!r} cannot be used ({reason}); expected cpu, or cuda where torch has it"
        ) from None
    return NETWORKS[header.network].part("backend")(network, header, device=device, compile=compile)


def no_poses(network: nn.Module, header: Header, **settings: Any) -> Backend:
    """Raises InputError. Placeholder for the backend of networks that do not predict joints."""
    raise InputError(f"the network {header.network} predicts no poses: give the weights of a pose network")


class TorchBackend:
    """Runs a `PoseNet` with torch."""

    name = "torch"

    def __init__(self, network: PoseNet, header: Header, *, device: str = "cpu", compile: bool = False):
        self.network = network.to(device).eval()
        self.header = header
        self.device = device
        self.batch = _CPU_BATCH if torch.device(device).type == "cpu" else _BATCH
        self._compile = compile
        self._module: Callable | None = None

    def __getstate__(self) -> dict:
        # a compiled module cannot be pickled
        return {**self.__dict__, "_module": None}

    @torch.inference_mode()
    def run(self, clouds: list[np.ndarray], view: np.ndarray) -> Raw:
        arrays = voxelize_people(clouds, view, self.network.config).arrays()
        tensors = [torch.as_tensor(array).to(self.device) for array in arrays.values()]
        if self._module is None:
            module = ArrayModule(self.network, tuple(arrays))
            self._module = torch.compile(module, dynamic=True) if self._compile else module
        try:
            values = self._module(*tensors)
        except torch._dynamo.exc.TorchDynamoException as error:
            reason = " ".join(str(error).split())[:160]
            raise InputError(f"torch.compile failed ({reason}): omit compile") from None
        names = output_names(self.network.config)
        return Raw.from_pose({name: value.cpu().numpy() for name, value in zip(names, values, strict=True)})


class _PaperBackend:
    """Common part of the backends of the paper's network and its baselines."""

    name = "torch"
    batch = _SLOW_BATCH

    def __init__(self, network: nn.Module, header: Header, *, device: str = "cpu", compile: bool = False):
        if compile:
            raise InputError("torch.compile is not supported for the paper's network and its baselines: omit compile")
        self.network: Any = network.to(device).eval()
        self.header = header
        self.device = device


class DaptBackend(_PaperBackend):
    """Runs the paper's network and reorders its joints to its skeleton. Like this package's own networks, it reads the
    points within `WINDOW`; it does not use the sensor position."""

    def run(self, clouds: list[np.ndarray], view: np.ndarray) -> Raw:
        config = self.network.config
        near_clouds = [cloud[(np.abs(cloud) < WINDOW).all(1)] for cloud in clouds]
        outputs = self.network.outputs(near_clouds)
        order = config.order_in(self.header.skeleton)
        if "logits_x" not in outputs:
            return Raw.from_joints(outputs["coordinates"][:, order])
        return Raw(
            vote=np.zeros((len(clouds), len(order), 3), np.float32),
            heatmaps=tuple(outputs[f"logits_{axis}"][:, order] for axis in "xyz"),
            low=config.low,
            step=config.step,
        )


class BaselineBackend(_PaperBackend):
    """Runs PRN or LPFormer. Their inputs are centered on the middle of the cloud's extent, which is added back to the
    joints, so the joints are in the frame of the cloud. Clouds with more points than the network reads are subsampled
    with a fixed seed."""

    @torch.inference_mode()
    def run(self, clouds: list[np.ndarray], view: np.ndarray) -> Raw:
        config = self.network.config
        arrays = pad_clouds(clouds, view, config, [0] * len(clouds))
        inputs = (torch.as_tensor(arrays[name]).to(self.device) for name in ("points", "valid", "center"))
        joints = self.network(*inputs).joints.float().cpu().numpy() + arrays["middle"][:, None]
        return Raw.from_joints(joints[:, config.order_in(self.header.skeleton)])


class ClipBackend(_PaperBackend):
    """Runs LiDARCap or NE. Without `clip`, each cloud is repeated to fill a clip. Clouds with more points than the
    network reads are subsampled with a fixed seed."""

    frames = CLIP_FRAMES

    @torch.inference_mode()
    def run(self, clouds: list[np.ndarray], view: np.ndarray, clip: Clips | None = None) -> Raw:
        rows = np.arange(len(clouds))
        clip = Clips(windows=np.repeat(rows[:, None], CLIP_FRAMES, 1)) if clip is None else clip
        config, clouds_by_name = self.network.config, {"person": clouds, **clip.around(rows)}
        inputs = {}
        for name in config.clouds:
            reach = WINDOW if name == "person" else np.inf
            points, valid = pad_frames(clouds_by_name[name], config, [0] * len(rows), window=reach)
            inputs[name] = torch.as_tensor(points).to(self.device), torch.as_tensor(valid).to(self.device)
        index = torch.as_tensor(clip.windows, device=self.device)
        # each frame is encoded once, even if it repeats in its clip
        outputs = self.network.decode({name: value[index] for name, value in self.network.encode(inputs).items()})
        joints = np.full((len(clouds), len(SMPL24), 3), np.nan, np.float32)
        frame_rows, positions = np.unique(clip.windows, return_index=True)
        # for a clip of a single repeated frame, take the middle position
        is_alone = np.ptp(clip.windows, axis=1) == 0
        positions = positions + CLIP_FRAMES // 2 * is_alone[positions // CLIP_FRAMES]
        joints[frame_rows] = outputs.posed().flatten(0, 1)[positions].float().cpu().numpy()
        return Raw.from_joints(joints)
