"""A network that corrects smoothed clips, trained and compared with the smoother: not released, see docs/log.md.

    python benchmarks/temporal.py train.npz judge.npz --seeds 0 1 2

Both files are written by `benchmarks/clips.py --store`, with different seeds and people. The network is a transformer
that reads 16 frames of a track (smoothed joints relative to the pelvis and the heading, offsets of the predictions from
them, spread, visibility, confidence, time). It predicts for each joint the coefficients of a cubic B-spline over time,
which is added to the smoothed joints. It is trained on complete clips, on clips with frames left out (every second or
third frame kept, a shorter clip, a gap), and on mirror images. Evaluated is the mean of the results for each clip and
its mirror image, with constant bone lengths.

Legend: C clips, T frames, K coefficients, J joints.
"""

import argparse
import copy
import math

import numpy as np
import torch
from clips import across, figures, nearest_seen
from torch import nn

from lidarpose.skeleton import BODY26, HUMAN15
from lidarpose.synth.bodies import CLIP_HZ
from lidarpose.tracking.bones import keep_lengths, length_statistics, lengths_of, rigid_bones
from lidarpose.tracking.clip import TrackPoses
from lidarpose.tracking.smoothing import known_spread, smooth, with_facing_corrected

SEGMENTS = 3
COEFFICIENTS = SEGMENTS + 3
WIDTH, LAYERS, HEADS, DROPOUT = 128, 3, 4, 0.2
# periods of the time embedding, s
PERIODS = (0.2, 0.4, 0.6, 0.8, 1.2, 1.6, 3.2, 6.4)
BATCH, RATE, DECAY, AVERAGE = 64, 1e-3, 0.05, 0.995
_GIVEN = ("joints", "spread", "visible", "confidence")
_FLIP, _MIRROR = list(BODY26.flip), np.array([1.0, -1.0, 1.0])
_PELVIS = BODY26.index("pelvis")


def spline_basis(fraction: np.ndarray) -> np.ndarray:
    """(..., K): values of the uniform cubic B-splines at `fraction` (...) in [0, 1] of a window."""
    place = np.clip(fraction, 0, 1) * SEGMENTS
    first = np.minimum(place.astype(int), SEGMENTS - 1)
    x = place - first
    weights = np.stack([(1 - x) ** 3, 3 * x**3 - 6 * x**2 + 4, -3 * x**3 + 3 * x**2 + 3 * x + 1, x**3], -1) / 6
    basis = np.zeros((*x.shape, COEFFICIENTS))
    np.put_along_axis(basis, first[..., None] + np.arange(4), weights, -1)
    return basis


def frames_left_out(frames: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(T,) bool each: the frames of a clip at a lower rate or a shorter clip, and those with a visible person."""
    stride = rng.choice([1, 1, 2, 3])
    is_present = np.zeros(frames, bool)
    is_present[rng.integers(stride) :: stride] = True
    start, stop = np.sort(rng.integers(frames + 1, size=2))
    if rng.random() < 0.5 and is_present[start:stop].sum() >= 3:
        is_present[:start] = is_present[stop:] = False
    is_seen = is_present.copy()
    if rng.random() < 0.5:
        start = rng.integers(frames)
        is_seen[start : start + rng.integers(1, 5)] = False
    return is_present, is_seen


def smoothed(clips: dict[str, np.ndarray], index: int, there: np.ndarray, seen: np.ndarray) -> dict | None:
    """A clip with the frames `there` (T,) bool, in which the person is visible in the frames `seen` (T,) bool: the
    predictions with corrected facing, smoothed joints `steady` and `steady_spread`, NaN in other frames; None if the
    person is visible in too few frames."""
    part = slice(np.flatnonzero(there)[0], np.flatnonzero(there)[-1] + 1)
    values = {name: np.array(clips[name][index], float) for name in _GIVEN}
    for value in values.values():
        value[~seen] = np.nan
    track = TrackPoses(
        times=np.arange(len(seen))[part] / CLIP_HZ, skeleton=BODY26, **{k: v[part] for k, v in values.items()}
    )
    if track.seen.sum() < 2:
        return None
    corrected_track, steady_track = with_facing_corrected(track), smooth(track)
    clip = {name: np.full(value.shape, np.nan) for name, value in values.items()}
    clip |= {"steady": clip["joints"].copy(), "steady_spread": clip["spread"].copy()}
    for name in _GIVEN:
        clip[name][part] = getattr(corrected_track, name)
    clip["steady"][part], clip["steady_spread"][part] = steady_track.joints, steady_track.spread
    clip["known"] = np.isfinite(clip["steady"]).all((1, 2))
    clip["there"] = there & clip["known"]
    return clip | {"true": clips["true"][index].astype(float)} if clip["there"].sum() > 1 else None


def stacked(clips: list[dict]) -> dict[str, np.ndarray]:
    return {name: np.stack([clip[name] for clip in clips]) for name in clips[0]}


def mirrored(clips: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Clips with left and right exchanged."""
    points = {name: (clips[name] * _MIRROR)[:, :, _FLIP] for name in ("true", "joints", "steady")}
    values = {name: clips[name][:, :, _FLIP] for name in ("spread", "visible", "confidence", "steady_spread")}
    return clips | points | values


def inputs(clips: dict[str, np.ndarray]) -> tuple[list[np.ndarray], np.ndarray]:
    """The network's inputs and targets: features (C, T, F), times (C, T) s relative to the middle, mask of present
    frames (C, T), spline basis (C, T, K), target correction (C, T, J, 3) m, mask of frames that count (C, T); and
    R_world_local."""
    steady = clips["steady"]
    y = np.nanmean(across(steady), 1) * [1, 1, 0] + [0, 1e-9, 0]
    y /= np.linalg.norm(y, axis=-1, keepdims=True)
    z = np.broadcast_to([0.0, 0.0, 1.0], y.shape)
    R_world_local = np.stack([np.cross(y, z), y, z], -1)
    root = np.nanmean(steady[:, :, _PELVIS], 1)[:, None, None]
    joints, steady, true = ((clips[k] - root) @ R_world_local[:, None] for k in ("joints", "steady", "true"))
    is_present, pelvis = clips["there"], steady[:, :, [_PELVIS]]
    feature_parts = (
        (steady - pelvis) / 0.3,
        pelvis / 0.3,
        (joints - steady) / 0.1,
        np.log(np.maximum(clips["spread"], 0.005) / 0.06),
        clips["visible"],
        clips["confidence"],
        np.log(clips["steady_spread"] / 0.06),
        np.isfinite(joints).all((2, 3)),
    )
    features = np.nan_to_num(np.concatenate([part.reshape(*is_present.shape, -1) for part in feature_parts], -1))
    times = np.broadcast_to(np.arange(is_present.shape[1]) / CLIP_HZ, is_present.shape)
    known_times = np.where(is_present, times, np.nan)
    first, last = np.nanmin(known_times, 1, keepdims=True), np.nanmax(known_times, 1, keepdims=True)
    is_counted = clips["known"] & (times >= first) & (times <= last)
    basis = spline_basis((times - first) / (last - first))
    arrays = [
        features * is_present[..., None],
        times - (first + last) / 2,
        is_present,
        basis,
        np.nan_to_num(true - steady),
        is_counted,
    ]
    return [a if a.dtype == bool else a.astype(np.float32) for a in arrays], R_world_local


class SplineNet(nn.Module):
    """A transformer with frames and coefficients as tokens; features (F) are normalized by mean and deviation (F,)."""

    def __init__(self, mean: torch.Tensor, deviation: torch.Tensor):
        super().__init__()
        self.register_buffer("mean", mean)
        self.register_buffer("deviation", deviation)
        self.register_buffer("frequencies", 2 * math.pi / torch.tensor(PERIODS))
        self.drop = nn.Dropout(DROPOUT)
        self.frame, self.time = nn.Linear(len(mean), WIDTH), nn.Linear(2 * len(PERIODS), WIDTH)
        self.coefficients = nn.Parameter(0.02 * torch.randn(COEFFICIENTS, WIDTH))
        layer = nn.TransformerEncoderLayer(WIDTH, HEADS, 2 * WIDTH, DROPOUT, "relu", batch_first=True, norm_first=True)
        self.encoder = nn.TransformerEncoder(layer, LAYERS, nn.LayerNorm(WIDTH), enable_nested_tensor=False)
        self.out = nn.Linear(WIDTH, 3 * len(BODY26))
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def waves(self, times: torch.Tensor) -> torch.Tensor:
        angles = times[..., None] * self.frequencies
        return self.time(torch.cat([angles.sin(), angles.cos()], -1))

    def forward(self, features, times, there, basis):
        """Corrections (C, T, J, 3) m of the smoothed joints."""
        first = times.masked_fill(~there, math.inf).amin(1, keepdim=True)
        last = times.masked_fill(~there, -math.inf).amax(1, keepdim=True)
        knots = first + (last - first) * (torch.arange(COEFFICIENTS) - 1) / SEGMENTS
        scaled = self.drop(((features - self.mean) / self.deviation).clip(-5, 5))
        tokens = torch.cat([self.frame(scaled) + self.waves(times), self.coefficients + self.waves(knots)], 1)
        hidden = nn.functional.pad(~there, (0, COEFFICIENTS))
        answer = 0.1 * self.out(self.encoder(tokens, src_key_padding_mask=hidden)[:, -COEFFICIENTS:])
        return (basis @ answer).reshape(*times.shape, len(BODY26), 3)


def train(clips: dict[str, np.ndarray], seed: int, epochs: int) -> SplineNet:
    """The moving average of a network trained on the clips; an epoch has half as many samples as there are clips."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    pairs = zip(inputs(clips)[0], inputs(mirrored(clips))[0], strict=True)
    data = [torch.from_numpy(np.concatenate(pair)) for pair in pairs]
    seen_features = data[0][data[2]]
    net = SplineNet(seen_features.mean(0), seen_features.std(0) + 0.05)
    average = copy.deepcopy(net)
    groups = [[p for p in net.parameters() if (p.ndim > 1) == matrix] for matrix in (True, False)]
    optimizer = torch.optim.AdamW(
        [{"params": groups[0], "weight_decay": DECAY}, {"params": groups[1], "weight_decay": 0.0}], betas=(0.9, 0.98)
    )
    # joints that are evaluated have double weight
    weight = torch.ones(len(BODY26))
    weight[torch.from_numpy(np.unique(BODY26.map_to(HUMAN15)))] = 2
    steps = epochs * len(clips["true"]) // (2 * BATCH)
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = RATE * min(1, (step + 1) / 100) * (0.5 + 0.5 * math.cos(math.pi * step / steps))
        rows = torch.from_numpy(rng.integers(len(data[0]), size=BATCH))
        *net_inputs, target, is_counted = (values[rows] for values in data)
        distance = ((net(*net_inputs) - target) ** 2).sum(-1).add(1e-4).sqrt()
        loss = ((distance * weight).mean(-1) * is_counted).sum() / is_counted.sum()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(net.parameters(), 0.3)
        optimizer.step()
        with torch.no_grad():
            keep = min(AVERAGE, (step + 1) / (step + 10))
            for mean, parameter in zip(average.parameters(), net.parameters(), strict=True):
                mean.lerp_(parameter, 1 - keep)
    return average.eval()


@torch.no_grad()
def corrected(net: SplineNet, clips: dict[str, np.ndarray]) -> np.ndarray:
    """Corrected joints (C, T, J, 3) m, NaN in frames without smoothed joints."""
    shifts = []
    for variant in (clips, mirrored(clips)):
        (*net_inputs, _, _), R_world_local = inputs(variant)
        shift = net(*map(torch.from_numpy, net_inputs)).numpy().astype(float)
        shifts.append(shift @ R_world_local[:, None].swapaxes(-1, -2))
    joints = clips["steady"] + (shifts[0] + (shifts[1] * _MIRROR)[:, :, _FLIP]) / 2
    bones = rigid_bones(BODY26)
    for clip, is_seen, spread in zip(joints, clips["known"], clips["steady_spread"], strict=True):
        variance = known_spread(spread, is_seen, len(BODY26))[is_seen] ** 2
        bone_sums = length_statistics(clip[is_seen], np.full_like(variance, 1e-6), bones)
        lengths = lengths_of(bone_sums.sum(0), bones, BODY26)
        clip[is_seen] = keep_lengths(clip[is_seen], variance, bones, lengths)
    return joints


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("train", help="npz of clips to learn")
    parser.add_argument("judge", help="npz of clips to be judged on")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--epochs", type=int, default=14)
    parser.add_argument("--motions", type=int, default=1, help="also by motion, of which the judged clips had so many")
    options = parser.parse_args()

    with np.load(options.train) as archive:
        clips = dict(archive)
    count, frames = clips["true"].shape[:2]
    all_frames = np.ones(frames, bool)
    selections = [(i, all_frames, all_frames) for i in range(count)]
    selections += [(i, *frames_left_out(frames, np.random.default_rng([0, i]))) for i in range(count)]
    training_clips = stacked([clip for selection in selections if (clip := smoothed(clips, *selection)) is not None])
    with np.load(options.judge) as archive:
        clips = dict(archive)
    test_clips = {
        i: clip for i in range(len(clips["true"])) if (clip := smoothed(clips, i, all_frames, all_frames)) is not None
    }
    motion, test_clips = np.array(list(test_clips)) % options.motions, stacked(list(test_clips.values()))
    base = np.stack([nearest_seen(joints) for joints in test_clips["steady"]])
    print(f"{len(training_clips['true'])} clips to learn, {len(base)} to judge")
    for seed in [None, *options.seeds]:
        joints = base
        if seed is not None:
            joints = np.stack(
                [
                    nearest_seen(clip_joints)
                    for clip_joints in corrected(train(training_clips, seed, options.epochs), test_clips)
                ]
            )
        values = figures(joints, base, test_clips["true"])
        mpjpe_less, acceleration_less = values["mpjpe_less"], values["acceleration_less"]
        name = "smoothed" if seed is None else f"seed {seed}"
        print(
            f"{name:9s} MPJPE {values['mpjpe']['value']:5.2f} mm, less {mpjpe_less[0]:4.1f} % "
            f"[{mpjpe_less[1]:.1f}, {mpjpe_less[2]:.1f}]"
            f"  acceleration {values['acceleration']['value']:5.2f}, less {acceleration_less[0]:4.1f} % "
            f"[{acceleration_less[1]:.1f}, {acceleration_less[2]:.1f}]  turned {values['turned_percent']:.2f} %  bones "
            f"{values['bone_deviation']:.1f} mm  by motion",
            *(
                f"{figures(joints[mask], base[mask], test_clips['true'][mask])['mpjpe']['value']:.1f}"
                for mask in (motion == k for k in range(options.motions))
            ),
            flush=True,
        )


if __name__ == "__main__":
    main()
