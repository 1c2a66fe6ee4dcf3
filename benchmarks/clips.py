"""Smoothness and accuracy of poses in clips: frame by frame, with a plain solve, and smoothed as by `predict_clip`.

    python benchmarks/clips.py --motion cmu_motion.npz:006,007 --store clips.npz --json docs/scores/clips.json

Clips have 16 frames at 10 Hz, in the scene preset `wild` (full difficulty, 14 sensors, 2.5 to 25 m). People and motion
were not used in training: --motion FILE[:SUBJECTS] or `prior`, which may be repeated and are used in turn; by default
activities of the prior. Sensors do not move. Poses are predicted once and stored in --store.

MPJPE is on the 15 joints of human15. Acceleration error: distance of second differences, mm per frame squared. Turned
round: the direction from right to left hips and shoulders is over 90 degrees off. Bone lengths: standard deviation over
a clip, mean over the bones of both limbs and the hips. Frames in which the person is not visible count, too: frame by
frame they repeat the nearest frame with a pose. The plain solve minimizes for each joint squared second differences
plus squared distances weighted by 1/spread^2, as one linear system.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
from stored import digest, is_stored, write_note

from lidarpose.inference.predictor import TTA, load
from lidarpose.io.atomic import write_atomic
from lidarpose.metrics import acceleration_errors, aligned_errors, interval, joint_errors
from lidarpose.models import DEFAULT, weights_path
from lidarpose.skeleton import BODY26, HUMAN15
from lidarpose.synth.bodies import CLIP_HZ, PoseBank
from lidarpose.synth.generator import Generator
from lidarpose.tracking.bones import rigid_bones
from lidarpose.tracking.clip import TrackPoses
from lidarpose.tracking.live import filter_track
from lidarpose.tracking.smoothing import smooth

# differs from the seeds of training runs and from that of the clips on which the smoother was tuned, 71001
SEED = 77_001
# weight of squared second differences in the plain solve: the best of 100, 300, 1000, 3000 on the tuning clips
STIFFNESS = 300.0
_PRIOR = "prior"
_VALUES = ("joints", "spread", "visible", "confidence")
_PICKED = BODY26.map_to(HUMAN15)


def make_clips(motion: list[str], count: int, seed: int, weights: str, looks: int) -> dict[str, np.ndarray]:
    """Ground truth (C, T, 26, 3) m and the network's predictions frame by frame, NaN in frames without the person."""
    generators = []
    for spec in motion or [_PRIOR]:
        path, _, subjects = spec.partition(":")
        if spec == _PRIOR:
            generators.append(Generator(scene="wild", measure=False))
        else:
            bank = PoseBank.from_clips(path, tuple(subjects.split(",")) if subjects else None)
            generators.append(Generator(scene="wild", bank=bank, captured=1.0, measure=False))
    # clips are small batches, which more threads only slow down
    model, clips = load(weights, tta=looks, threads=1), []
    for index in range(count):
        people = generators[index % len(generators)].clip(seed, index)
        clouds = [np.asarray(person.sample.points, float) for person in people]
        poses = [person.pose for person in model.predict(clouds, sensor_origin=(0, 0, 0), skeleton="body26")]
        track = TrackPoses.of_poses(np.arange(len(poses)), poses, BODY26)
        true = np.stack([person.sample.pose.joints for person in people])
        clips.append({"true": true} | {name: getattr(track, name) for name in _VALUES})
        print(f"\r{index + 1} of {count} clips", end="", flush=True)
    print()
    return {name: np.stack([clip[name] for clip in clips]) for name in clips[0]}


def nearest_seen(joints: np.ndarray) -> np.ndarray:
    """Joints (T, J, 3) in which frames without joints repeat the nearest frame that has some."""
    frames = np.arange(len(joints))
    seen_frames = np.flatnonzero(np.isfinite(joints).all((1, 2)))
    return joints[seen_frames[np.abs(frames[:, None] - seen_frames).argmin(1)]]


def plain_solve(track: TrackPoses) -> np.ndarray:
    """Joints (T, J, 3) m of the plain solve."""
    frames = len(track)
    second_differences = np.diff(np.eye(frames), 2, axis=0)
    weight = np.where(track.seen[:, None], track.spread**-2, 0.0)
    known_joints = np.where(track.seen[:, None, None], track.joints, 0.0)
    system = STIFFNESS * second_differences.T @ second_differences + np.eye(frames) * weight.T[:, :, None]
    return np.linalg.solve(system, (weight[..., None] * known_joints).swapaxes(0, 1)).swapaxes(0, 1)


def live_joints(track: TrackPoses) -> np.ndarray:
    """Joints (T, J, 3) m of the live filter, NaN in frames without joints."""
    return TrackPoses.of_poses(track.times, filter_track(track), BODY26).joints


WAYS = {
    "frame by frame": lambda track: track.joints,
    "plain solve": plain_solve,
    "smoothed": lambda track: smooth(track).joints,
    "live": live_joints,
}


def across(joints: np.ndarray) -> np.ndarray:
    """The sum (..., 3) of the vectors from the right to the left hip and from the right to the left shoulder."""
    index = BODY26.index
    return sum(
        joints[..., index(f"left_{name}"), :] - joints[..., index(f"right_{name}"), :] for name in ("hip", "shoulder")
    )


def figures(joints: np.ndarray, base: np.ndarray, true: np.ndarray) -> dict:
    """Figures of clips (C, T, 26, 3) m, with intervals over clips; base: the joints predicted frame by frame."""
    rng = np.random.default_rng(0)
    count = len(true)

    def errors(pred):
        picked, truth = (a[:, :, _PICKED] for a in (pred, true))
        return joint_errors(picked, truth).reshape(count, -1), acceleration_errors(picked, truth, 1.0)

    bones = rigid_bones(HUMAN15)
    ends = joints[:, :, _PICKED][:, :, bones]
    lengths = 1e3 * np.linalg.norm(ends[..., 0, :] - ends[..., 1, :], axis=-1)
    is_turned, was_turned = ((across(a) * across(true)).sum(-1) < 0 for a in (joints, base))
    is_mostly_right = was_turned.mean(1) < 0.5
    values = {}
    for name, own_errors, base_errors in zip(("mpjpe", "acceleration"), errors(joints), errors(base), strict=True):
        mean = interval(own_errors, rng)
        values[name] = {"value": float(own_errors.mean()), "low": mean.low, "high": mean.high}
        draws = np.concatenate([np.arange(count)[None], rng.integers(count, size=(2000, count))])
        reduction = 100 * (1 - own_errors.mean(1)[draws].mean(1) / base_errors.mean(1)[draws].mean(1))
        values[f"{name}_less"] = [float(reduction[0]), *np.percentile(reduction[1:], [2.5, 97.5]).tolist()]
    return values | {
        "pa_mpjpe": float(aligned_errors(joints[:, :, _PICKED], true[:, :, _PICKED]).mean()),
        "p95": float(np.percentile(errors(joints)[0], 95)),
        "turned_percent": float(100 * is_turned.mean()),
        "clips_mostly_right": int(is_mostly_right.sum()),
        "turned_clips_of_these": int(is_turned[is_mostly_right].any(1).sum()),
        "turned_frames_of_these": int(is_turned[is_mostly_right].sum()),
        "bone_deviation": float(lengths.std(1).mean()),
    }


def run(clips: dict[str, np.ndarray]) -> dict:
    """The figures of each entry in `WAYS`."""
    tracks = [
        TrackPoses(
            times=np.arange(clips["true"].shape[1]) / CLIP_HZ,
            skeleton=BODY26,
            **{name: clips[name][i] for name in _VALUES},
        )
        for i in range(len(clips["true"]))
    ]
    is_seen = np.array([track.seen.any() for track in tracks])
    tracks, true = [track for track in tracks if track.seen.any()], clips["true"][is_seen]
    report, base = {"clips": len(tracks), "unseen_clips": int((~is_seen).sum()), "ways": {}}, None
    for name, solve in WAYS.items():
        start = time.perf_counter()
        way_joints = [solve(track) for track in tracks]
        seconds = time.perf_counter() - start
        joints = np.stack([nearest_seen(track_joints) for track_joints in way_joints])
        base = joints if base is None else base
        report["ways"][name] = figures(joints, base, true) | {"ms_a_frame": 1e3 * seconds / true[..., 0, 0].size}
    steady_tracks = [smooth(track) for track in tracks]
    is_known = np.stack([track.seen for track in steady_tracks])
    spread = np.stack([track.spread for track in steady_tracks])[is_known]
    error = np.linalg.norm(np.stack([track.joints for track in steady_tracks])[is_known] - true[is_known], axis=-1)
    report["spread_over_error"] = float(spread.mean() / error.mean())
    tenths = np.array_split(np.argsort(spread.ravel()), 10)
    report["spread_tenths_mm"] = [[1e3 * float(v.ravel()[i].mean()) for v in (spread, error)] for i in tenths]
    return report


def hidden(clips: dict[str, np.ndarray], gap: int) -> list[list[float]]:
    """Mean spread and error, mm, in frames hidden in the middle of clips, by distance in frames to a visible frame."""
    count, frames = clips["true"].shape[:2]
    rows = np.arange((frames - gap) // 2, (frames - gap) // 2 + gap)
    frames_to_seen = np.minimum(rows - rows[0], rows[-1] - rows)
    means = []
    for i in range(count):
        values = {name: clips[name][i].copy() for name in _VALUES}
        values["joints"][rows] = np.nan
        track = smooth(TrackPoses(times=np.arange(frames) / CLIP_HZ, skeleton=BODY26, **values))
        error = np.linalg.norm(track.joints - clips["true"][i], axis=-1)
        if track.filled[rows].all():
            means.append(1e3 * np.stack([track.spread[rows], error[rows]]))
    means = np.stack(means)
    return [means[:, :, frames_to_seen == k].mean((0, 2, 3)).tolist() for k in range(frames_to_seen.max() + 1)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motion", action="append", default=[], metavar="FILE[:SUBJECTS]")
    parser.add_argument("--looks", type=int, default=TTA, help="transforms that each prediction is the mean of")
    parser.add_argument("--weights", default=DEFAULT)
    parser.add_argument("--clips", type=int, default=120)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--store", type=Path, help="npz of predicted clips: read where it is there, else written")
    parser.add_argument("--hide", type=int, nargs="+", default=[], metavar="N", help="also hide N frames in the middle")
    parser.add_argument("--json", help="also write the figures to this file")
    options = parser.parse_args()

    of = {name: getattr(options, name) for name in ("motion", "clips", "seed", "looks")}
    of["weights"] = digest(weights_path(options.weights))
    if options.store and is_stored(options.store, of):
        with np.load(options.store) as archive:
            clips = dict(archive)
    else:
        clips = make_clips(options.motion, options.clips, options.seed, options.weights, options.looks)
        if options.store:
            write_note(options.store, of)
            np.savez_compressed(options.store, **clips)
    report = run(clips)
    for name, row in report["ways"].items():
        mpjpe_less, acceleration_less = row["mpjpe_less"], row["acceleration_less"]
        print(
            f"{name:15s} MPJPE {row['mpjpe']['value']:5.1f} mm, less {mpjpe_less[0]:4.1f} % "
            f"[{mpjpe_less[1]:.1f}, {mpjpe_less[2]:.1f}]"
            f"  acceleration {row['acceleration']['value']:5.1f}, less {acceleration_less[0]:4.1f} % "
            f"[{acceleration_less[1]:.1f}, {acceleration_less[2]:.1f}]"
            f"  PA {row['pa_mpjpe']:4.1f}  p95 {row['p95']:5.1f}  turned {row['turned_percent']:.2f} %"
            f" ({row['turned_clips_of_these']} of {row['clips_mostly_right']} clips)"
            f"  bones {row['bone_deviation']:4.1f} mm  {row['ms_a_frame']:.2f} ms"
        )
    print(f"spread / error {report['spread_over_error']:.2f}")
    for gap in options.hide:
        print(
            f"{gap} frames hidden, spread and error in mm:", [[round(v) for v in pair] for pair in hidden(clips, gap)]
        )
    if options.json:
        write_atomic(Path(options.json), json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
