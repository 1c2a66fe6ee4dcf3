"""How scenes are drawn: a configuration and its presets."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from math import inf, pi
from numbers import Real
from typing import Any

import numpy as np

from lidarpose.errors import InputError, check_name
from lidarpose.lidar.presets import sensor


class RandomStream(IntEnum):
    """Second word of a random generator's seed, (seed, stream, index): draws of one stream never affect another.

    Values must not change: every dataset and bench was made with them. 5 has two uses, boxes in street datasets and
    augmentation of stored people in training, which never share a sample. 9 and 10 are for torch, in the training loop.
    Numpy treats (seed, stream, index, 0) like (seed, stream, index): a further word gives a separate stream only if it
    is not 0.
    """

    BLOCK = 0
    PERSON = 1
    SYNTHETIC_AUGMENTATION = 2
    CLIP = 3
    STREET = 4
    STREET_BOXES = 5
    STORED_AUGMENTATION = 5
    EPOCH_ORDER = 6
    BATCH_ORDER = 8
    INITIAL_WEIGHTS = 9
    TRAINING_STEP = 10
    DETECTION = 11
    CANDIDATES = 12
    ACQUISITION = 13
    MOTION = 14
    OBJECT = 15
    OBJECT_ACQUISITION = 16


# maximum standard deviation of the ground's tilt, rad; a larger value was probably meant in degrees
STEEPEST = pi / 4
# ways of scanning single people other than by one scan of an upright sensor
ACQUISITIONS = ("merged", "accumulated", "inverted", "integration", "sparse", "crowded")
# fields with values between 0 and 1
_SHARES = frozenset(
    "clutter occluder company apart unusual tempo merged double_rate accumulated inverted integration sparse crowded "
    "recorded clear_limbs hard mask ground_window box_window mask_keep missing_part intensity_dropout beam_divergence "
    "dapt_compat loose cut".split()
)
# fields that are 0 or 1
_SWITCHES = frozenset("apart recorded ground_window box_window clear_limbs dapt_compat".split())


def _check_fields(config: Any) -> None:
    """Raises InputError if a number, or one of a pair, is negative, infinite or, for a share, above 1; converts pairs
    to tuples."""
    for field in fields(config):
        value, is_pair = getattr(config, field.name), field.type == tuple[float, float]
        if is_pair and isinstance(value, list | np.ndarray):
            value = tuple(value)
            object.__setattr__(config, field.name, value)
        if not is_pair and field.type not in (float, int):
            continue
        numbers = value if is_pair else (value,)
        most = 1 if field.name in _SHARES else STEEPEST if field.name == "slope" else inf
        is_valid = isinstance(numbers, tuple) and len(numbers) == 1 + is_pair
        if not (is_valid and all(isinstance(n, Real) and 0 <= float(n) <= most and n != inf for n in numbers)):
            bounds = "of at least 0" if most == inf else f"from 0 to {most:.3g}"
            expected = f"{'two numbers' if is_pair else 'a number'} {bounds}{' rad' if most == STEEPEST else ''}"
            raise InputError(f"{type(config).__name__}.{field.name} must be {expected}, got {value!r}")
        if numbers[0] > numbers[-1]:
            raise InputError(f"{type(config).__name__}.{field.name} must be (low, high), got {value!r}")


@dataclass(frozen=True, kw_only=True)
class NoiseConfig:
    """Errors of returns. Values are probabilities unless a unit is named; each is off by default.

    Args:
        mask: laser-level mask; the share of patches that it keeps is drawn from the range `mask_keep`.
        clutter: clusters of points that no surface returned, at most `most_clutter` points each.
        missing_part: all returns of one body part are dropped.
        intensity_dropout: maximum loss probability of returns at grazing incidence or far away.
        beam_divergence: beams of 1.5 to 3 mrad instead of lines, so that silhouettes become wider and edges give mixed
            ranges (spinning sensors only).
        sigma: range of a factor on the sensor's range noise.
        ring_bias: range of the standard deviation of an error that all points of a ring share, m.
        dapt_compat: behavior of the released code instead: ranges 0 to 2 cm too long, clutter with its own
            distribution, the beams at +-pi twice.
    """

    mask: float = 0.0
    mask_keep: tuple[float, float] = (0.6, 0.6)
    clutter: float = 0.0
    most_clutter: int = 149
    missing_part: float = 0.0
    intensity_dropout: float = 0.0
    beam_divergence: float = 0.0
    sigma: tuple[float, float] = (1.0, 1.0)
    ring_bias: tuple[float, float] = (0.0, 0.0)
    dapt_compat: bool = False

    def __post_init__(self):
        _check_fields(self)


@dataclass(frozen=True, kw_only=True)
class CropErrors:
    """Errors of a crop's box. jitter m: standard deviation of its center (and, in rad, of its yaw); loose: share of
    boxes that are far too large, as if drawn by hand; cut: share of boxes that cut off the feet, the head or a side."""

    jitter: float = 0.0
    loose: float = 0.0
    cut: float = 0.0

    def __post_init__(self):
        _check_fields(self)


@dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """How scenes are drawn. Values are probabilities unless a unit is named.

    Args:
        name: of the preset, part of each sample's source.
        sensors: names or files of tables; a repeated entry is drawn more often.
        distance: minimum and maximum, m.
        median_points: median of the log-normal distribution of point counts; 0: distance uniform as in the paper.
        mount: standard deviation of the sensor's height, m; 0: its nominal height whether the person fits or not.
        slope: standard deviation of the ground's tilt, rad.
        margin: margin of the window of beams around the body, rad.
        around: additional margin of this window, m at the person.
        ground_window: 1: the window of beams, and with it the laser mask, is around the body and the ground, as in the
            paper's Eq. 3; 0: around the body alone, as in the released code.
        box_window: 1: the window of beams covers the crop's box, too; 0: a large box has an empty rim.
        clutter: things near the person.
        occluder: an object in front of the person.
        company: a second person in or before the crop.
        apart: 1: a second person does not overlap the first; 0: the two may overlap.
        unusual: share of poses, of those not captured, that the default mix has hardly any of: squat, kick, throw, hop,
            pick something up, sit and lie on the floor and so on.
        carry: how often things are carried or used, relative to `draw_props`.
        tempo: captured motion of clips and accumulated frames is played at exp(-tempo) to exp(tempo) times its speed.
        merged: the cloud of 2 to 4 sensors around the person, see `Acquisition`; this and the next six apply to single
            people only, not to clips.
        double_rate: of the spinning sensors that are merged with the first one, the share that turns twice as fast:
            two scans of half as many columns, half a period apart.
        accumulated: 2 to 5 frames of a moving person in one cloud.
        inverted: sensors mounted upside down, 2 to 5 m above the ground.
        integration: rosettes that integrate 0.2 or 0.5 s, a third of the share each; for the last third, the sensor is
            drawn again for a single scan.
        sparse: sensors of 16 and 32 rings at a uniform distance of up to 25 m.
        crowded: crops with a second person; the box's center is nearer to the person meant.
        noise: errors of returns.
        crop: errors of the crop's box.
        recorded: 1: captured people stand where they were recorded, without the paper's scene sampling; 0: they are
            placed at random.
        clear_limbs: 1: forearms, hands and shanks that a captured pose puts inside the drawn body, which may be wider
            than the captured person, are rotated out of it; 0: they stay there.
        clothes: factor on the offset of clothes and hair from the skin; 0: no clothes but skirts and hats, which
            `carry` draws.
        hard: difficulty in [0, 1]; scales the probability of occlusion and of errors in the crop, not the sensor's own
            noise. Jitter of boxes and the limits of the field of view do not depend on it.
    """

    name: str
    sensors: tuple[str, ...]
    distance: tuple[float, float]
    median_points: float = 0
    mount: float = 0.0
    slope: float
    margin: float = 0.0
    around: float = 0.0
    ground_window: float = 0.0
    box_window: float = 0.0
    clutter: float = 0.0
    occluder: float = 0.0
    company: float = 0.0
    apart: float = 0.0
    unusual: float = 0.0
    carry: float = 0.0
    tempo: float = 0.0
    merged: float = 0.0
    double_rate: float = 0.0
    accumulated: float = 0.0
    inverted: float = 0.0
    integration: float = 0.0
    sparse: float = 0.0
    crowded: float = 0.0
    noise: NoiseConfig
    crop: CropErrors = CropErrors()
    recorded: float = 0.0
    clear_limbs: float = 0.0
    clothes: float = 1.0
    hard: float = 1.0

    def __post_init__(self):
        _check_fields(self)
        if not (isinstance(self.noise, NoiseConfig) and isinstance(self.crop, CropErrors)):
            raise InputError("SceneConfig.noise must be a NoiseConfig and SceneConfig.crop CropErrors")
        if not self.sensors:
            raise InputError("SceneConfig.sensors must name at least one sensor, got none")

    @property
    def varied(self) -> bool:
        """Whether people may be scanned in other ways than by one scan of an upright sensor."""
        return any(getattr(self, name) for name in ACQUISITIONS)

    @property
    def follows_paper(self) -> bool:
        """Whether every sample follows the paper: on bare ground, with one difficulty, always masked."""
        return self.name in ("paper", "reference")

    def eased(self, hard: float) -> "SceneConfig":
        """The same scenes at a difficulty of `hard` in [0, 1]."""
        return replace(self, hard=hard)

    def changed(self, settings: Sequence[str]) -> "SceneConfig":
        """The same scenes with some fields changed, each given as "name=value": a field of the scene, its noise or its
        crops; a range is "distance=4:12"; the noise's clutter is "noise.clutter". "keep=R" is the paper's r_keep: every
        sample is masked and keeps a share R; several sensors are "sensors=NAME:NAME", which sets `sparse` to 0 unless
        it is given too. Raises InputError for an unknown field or an invalid value.
        """
        scene = self
        for setting in settings:
            scene = _changed(scene, *setting.partition("=")[::2])
        names = {setting.partition("=")[0] for setting in settings}
        # `sparse` would replace the chosen sensors by others
        return replace(scene, sparse=0.0) if "sensors" in names and "sparse" not in names else scene


def _changed(scene: SceneConfig, name: str, text: str) -> SceneConfig:
    """The scene with one field changed, see `SceneConfig.changed`."""
    groups: dict[str, Any] = {"": scene, "noise": scene.noise, "crop": scene.crop}
    targets: dict[str, tuple[str, str]] = {"keep": ("noise", "mask_keep")}
    for group, config in groups.items():
        for field in fields(config):
            if isinstance(getattr(config, field.name), int | float | tuple) and field.name != "sensors":
                # the scene and its noise both have a field `clutter`
                targets[f"{group}.{field.name}" if field.name in targets else field.name] = (group, field.name)
    if name == "sensors":
        for sensor_name in text.split(":"):
            sensor(sensor_name)
        return replace(scene, sensors=tuple(text.split(":")))
    check_name("setting of the scene", name, ("sensors", *targets))
    group, field_name = targets[name]
    declared: Any = {field.name: field.type for field in fields(groups[group])}[field_name]
    is_pair = declared == tuple[float, float]
    try:
        numbers = [float(part) for part in text.split(":")]
        is_valid = len(numbers) in ((1, 2) if is_pair else (1,)) and all(0 <= n < inf for n in numbers)
        if not is_valid or numbers[0] > numbers[-1]:
            raise ValueError
    except ValueError:
        expected = "a number or two, LOW:HIGH" if is_pair else "a number"
        raise InputError(f"expected {name}={expected}, at least 0, got {name}={text}") from None
    if field_name in _SHARES and numbers[-1] > 1:
        raise InputError(f"{name} must be between 0 and 1, got {text}")
    if (declared is int or field_name in _SWITCHES) and numbers[0] % 1:
        raise InputError(f"{name} must be {'a whole number' if declared is int else '0 or 1'}, got {text}")
    value = (numbers[0], numbers[-1]) if is_pair else declared(numbers[0])
    changes: dict[str, Any] = {field_name: value} | ({"mask": 1.0} if name == "keep" else {})
    if not group:
        return replace(scene, **changes)
    return replace(scene, **{group: replace(groups[group], **changes)})


# Paper: section "Scene sampling": r in [4, 20] m, a tilted square of ground, the effective window without a margin,
# s_p and r_keep of "Laser-level masking". Clusters of noise are named only among its stability tests.
_PAPER = SceneConfig(
    name="paper", sensors=("dapt64",), distance=(4.0, 20.0), slope=np.radians(5.0), noise=NoiseConfig(mask=1.0)
)

SCENES = {
    "paper": _PAPER,
    # differences of the released code from the paper: 5 to 20 m, a margin of 1.8 degrees around the body, ranges 0 to
    # 2 cm too long, clusters of noise in half of the samples, one body part missing in half of them, the beams at the
    # seam twice
    "reference": replace(
        _PAPER,
        name="reference",
        distance=(5.0, 20.0),
        margin=np.radians(1.8),
        noise=NoiseConfig(mask=1.0, clutter=0.5, missing_part=0.5, dapt_compat=True),
    ),
    # sensors, point counts and crops as in users' data: 50 to 900 points per person, boxes of real detectors
    "wild": SceneConfig(
        name="wild",
        sensors=(
            *("dapt64", "vlp-32c", "os1-128", "os1-64", "hdl-64e", "hdl-32e", "vlp-16", "waymo-top", "pandar64", "av2"),
            *("os0-128", "os1-128"),
            # one in five is a rosette
            *("livox-mid360", "livox-avia", "livox-mid100"),
        ),
        distance=(1.5, 40.0),
        median_points=260,
        mount=0.3,
        slope=np.radians(3.0),
        around=0.3,
        clutter=0.35,
        occluder=0.28,
        company=0.15,
        carry=1.0,
        noise=NoiseConfig(
            mask=0.3,
            mask_keep=(0.55, 1.0),
            clutter=0.08,
            most_clutter=90,
            missing_part=0.1,
            intensity_dropout=0.9,
            beam_divergence=0.2,
            # measured on VLP-32C sweeps: 5 to 7 mm along a ring, 10 to 15 mm between rings of one object
            sigma=(0.2, 1.0),
            ring_bias=(0.004, 0.016),
        ),
        crop=CropErrors(jitter=0.08, loose=0.125, cut=0.15),
    ),
}


# "wild" plus unusual poses, clouds of several scans, inverted sensors, few rings and two people in one crop; limbs of
# captured people are outside the drawn body, second people do not overlap the first, and boxes have no empty rim
SCENES["wide"] = replace(
    SCENES["wild"],
    name="wide",
    box_window=1.0,
    apart=1.0,
    unusual=0.3,
    merged=0.06,
    accumulated=0.06,
    inverted=0.08,
    integration=0.5,
    sparse=0.12,
    crowded=0.05,
    clear_limbs=1.0,
)


def scene_config(name: str) -> SceneConfig:
    """The named scene preset: paper, reference, wild or wide."""
    check_name("scene", name, SCENES)
    return SCENES[name]
