"""Imports the authors' weights: a safetensors file of theirs, checked tensor by tensor, becomes a `DaptNet`.

Only safetensors is read. The authors' .pth and .bin files are pickles, which can run any program when they are opened,
so their conversion is left to users who trust them.
"""

import json
import os
from pathlib import Path

import torch

from lidarpose.errors import InputError
from lidarpose.io.atomic import check_suffix
from lidarpose.io.files import check_not_input, file_error
from lidarpose.models.checkpoint import Header, SafetensorsFile, save_checkpoint
from lidarpose.models.dapt.dapt_config import CONFIGS, RELEASED_FAULTS, DaptConfig, named_config
from lidarpose.models.dapt.dapt_net import DaptNet

# prefix that a multi-GPU wrapper adds to every name
_PREFIX = "module."
_PICKLES = (".pth", ".pt", ".bin", ".ckpt", ".pkl")


def import_dapt(path: str | os.PathLike, config: DaptConfig | dict | str | None = None) -> DaptNet:
    """The released network in evaluation mode, float32 on the CPU, with the data flow that it was trained with.

    Args:
        path: the weights as .safetensors. All names of tensors may begin with "module.".
        config: a `DaptConfig`, its entries or the authors' constructor arguments as a dict (`DaptConfig.from_dict`), or
            a name (waymo, humanm3, lidarhuman26m, sloper4d, pretrain); None reads the file's header, entry "config".
            `RELEASED_FAULTS` are on unless a `DaptConfig` or a dict says otherwise.

    Raises:
        InputError: one line that names the file and the tensor, if anything does not fit.
    """
    path = Path(path)
    if path.suffix.lower() in _PICKLES and path.exists():
        raise file_error(
            path,
            "expected a .safetensors file, got a pickle, which can run programs: if you trust it, convert it once with "
            "safetensors.torch.save_file(torch.load(FILE, map_location='cpu', weights_only=True), 'dapt.safetensors')",
        )
    file = SafetensorsFile.open(path, prefix=_PREFIX)
    config = _config(path, file.metadata, config)
    remedy = f"give the configuration that it was trained with ({', '.join(CONFIGS)})"
    network = file.network(config, source=f"the configuration {config.name}", remedy=remedy)
    # the released heatmap head stores its ranges: they must equal those with which its logits will be decoded
    ranges = network.state_dict().get("heads.query.coord_range")
    if ranges is not None and not torch.allclose(ranges, torch.tensor(config.ranges), atol=1e-4):
        raise file_error(
            path,
            f"tensor heads.query.coord_range says {ranges.double().round(decimals=4).tolist()} m, but the "
            f"configuration {config.name} says {[list(bounds) for bounds in config.ranges]}: {remedy}",
        )
    return network


def import_released(source: str | os.PathLike, out: str | os.PathLike, *, config: str | None = None) -> Header:
    """Writes the authors' weights at `source` as a checkpoint of this package; config: as for `import_dapt`.

    Raises InputError, one line that names the file and the tensor, if anything does not fit; then nothing is written.
    """
    check_suffix(out, ".safetensors")
    check_not_input(out, source)
    network = import_dapt(source, config)
    option = "" if config is None else f" --config {config}"
    card = {
        "command": f"lidarpose import {Path(source).name}{option}",
        "note": "released DAPT weights; confidence and spread are read off its heatmaps and not calibrated",
    }
    save_checkpoint(out, network, card=card)
    return Header(config=network.config, card=card)


def _config(path: Path, metadata: dict[str, str], config: DaptConfig | dict | str | None) -> DaptConfig:
    if isinstance(config, DaptConfig):
        return config
    if isinstance(config, str):
        return named_config(config)
    source, remedy = "the configuration given", f"give one of {', '.join(CONFIGS)}"
    if config is None:
        source = "its header's configuration"
        try:
            config = json.loads(metadata["config"])
        except KeyError:
            raise file_error(path, f"its header has no configuration: {remedy} (config=...)") from None
        except (ValueError, RecursionError) as error:
            raise file_error(path, f"{source} is not JSON ({error}): {remedy}") from None
    if not isinstance(config, dict):
        raise file_error(path, f"{source} should be a dict, a name or a DaptConfig, got {type(config).__name__}")
    try:
        return DaptConfig.from_dict(RELEASED_FAULTS | config)
    # TypeError: lists and dicts where numbers and names belong
    except (InputError, TypeError) as error:
        raise file_error(path, f"{source} does not fit: {error}") from None
