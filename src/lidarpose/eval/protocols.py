"""Runs a network on a dataset under one of two protocols, whose scores are not comparable. A protocol defines how a
person is cropped and centered before the network sees the points.

clean   what a user has: the crop is a detector's box (the labeled box, displaced, see `jittered`), centers are
        computed from the points and that box, and no sequence is in both training and test
dapt    what the paper's released code does: crop and center from the labels, a single pass, its splits
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from lidarpose.data.clips import consecutive
from lidarpose.errors import InputError, check_int, check_name
from lidarpose.eval.dataset import EvalDataset, EvalSample
from lidarpose.eval.predictions import Predictions, num_nearby, stack
from lidarpose.eval.scores import Setting
from lidarpose.inference.inputs import Clips
from lidarpose.inference.newest import newest_points
from lidarpose.io.files import one_line, shorten
from lidarpose.sample import PER_PERSON, UNLABELED, Box, LabeledSample, Pose, clip_windows, known_values
from lidarpose.skeleton import Skeleton, skeleton as skeleton_of

PROTOCOLS = ("clean", "dapt")

# standard deviations of a detector's errors, each clipped at twice its value: of the center along x and y, and along z,
# m; of the logarithm of each edge; of the yaw, rad
CENTER_SIGMA, HEIGHT_SIGMA, SIZE_SIGMA, YAW_SIGMA = 0.1, 0.05, 0.05, 0.1
_CUT = 2.0


@dataclass(frozen=True, kw_only=True)
class DaptProtocol:
    """What the released code does with a dataset: center, the key in `LabeledSample.centers`; centring, the same in
    words; crop in words; split: the name that `prepare` must have split by; least: minimum number of points of a person
    that it scores; without: joints that it leaves out of its means."""

    center: str
    centring: str
    crop: str
    split: str = "official"
    least: int = 1
    without: tuple[str, ...] = ()


_SEGMENTED = "people as the dataset segmented them"
DAPT = {
    "waymo": DaptProtocol(center="box", centring="labelled box (oracle)", crop="points in the labelled box"),
    "humanm3": DaptProtocol(
        center="joints_box",
        centring="box of the true joints (oracle)",
        crop="points in the box of the true joints, 1.25 times as large",
        without=("pelvis",),
    ),
    "lidarhuman26m": DaptProtocol(center="trans", centring="SMPL trans (oracle)", crop=_SEGMENTED),
    "sloper4d": DaptProtocol(center="trans", centring="SMPL trans (oracle)", crop=_SEGMENTED, split="dapt", least=10),
}
_CLEAN_CROPS = {
    "waymo": "labelled box with a detector's errors",
    "humanm3": "box about the true joints with a detector's errors",
    "itop": "side view: cut out without labels; top view: box about the true joints with a detector's errors",
    "bench": "the set's own detector's box",
    "synth": "the set's own detector's box",
}
_UNBOXED = f"{_SEGMENTED}: there is no box, so none could be displaced"
# sets whose crops are already a detector's
_OWN_CROP = ("bench", "synth")


# size of the released code's box for HumanM3, as a multiple of the extent of the labeled joints
_ROOM = 1.25
# minimum edge of that box, m
_LEAST_EDGE = 1e-6


def check_protocol(protocol: str, dataset: EvalDataset) -> None:
    """Raises InputError, one line, if the dataset cannot be scored under the protocol."""
    check_name("protocol", protocol, PROTOCOLS)
    name, kind, split_by = dataset.name, dataset.kind, dataset.settings.get("split_by")
    # a dataset.json that was edited may hold any text
    kind_text, split_text = (shorten(one_line(str(value or "nothing"))) for value in (kind, split_by))
    if protocol == "clean":
        if split_by == "dapt":
            raise InputError(
                f"{name} was split by dapt, where neighboring frames are in train and test: use protocol dapt, or "
                f"run lidarpose prepare {kind_text} RAW OUT again without --split-by dapt"
            )
        return
    if kind in _OWN_CROP:
        raise InputError(
            f"the protocol dapt centers on labels of real datasets, {name} is synthetic: use protocol clean"
        )
    if kind not in DAPT:
        evaluated = ", ".join(DAPT)
        raise InputError(f"the released code evaluates {evaluated}, not {kind_text}: use protocol clean for {name}")
    if split_by != (expected_split := DAPT[kind].split):
        raise InputError(
            f"{name} was split by {split_text}, the protocol dapt is by {expected_split}: run lidarpose "
            f"prepare {kind} RAW OUT --split-by {expected_split} into another folder"
        )


def jittered(box: Box, rng: np.random.Generator) -> Box:
    """The box with a detector's errors: its center off by 10 cm (5 cm in height), its edges by 5 %, its yaw by 0.1 rad.
    These are standard deviations of normal errors, clipped at twice that."""
    step = np.clip(rng.standard_normal(7), -_CUT, _CUT)
    shift = step[:3] * [CENTER_SIGMA, CENTER_SIGMA, HEIGHT_SIGMA]
    return replace(
        box,
        center=box.center + shift,
        size=box.size * np.exp(SIZE_SIGMA * step[3:6]),
        yaw=float(box.yaw + YAW_SIGMA * step[6]),
    )


def released_view(
    points: np.ndarray, joints: np.ndarray, centers: dict[str, np.ndarray], box: Box | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """points (n, 3) m, joints (J, 3) m, NaN without a label -> (n,) bool of the points in the crop, and the center
    (3,) m.

    "trans" (LiDARHuman26M, SLOPER4D): all points, centered on SMPL's translation; "joints_box" (HumanM3): an
    axis-aligned box of 1.25 times the joints' extent; "box" (Waymo): the labeled box. For a dataset with none of these
    all points, and None.
    """
    center = next((centers[name] for name in ("trans", "joints_box", "box") if name in centers), None)
    crop = None if center is None or "trans" in centers else released_box(joints, centers, box)
    return np.ones(len(points), bool) if crop is None else crop.contains(points), center


def released_box(joints: np.ndarray, centers: dict[str, np.ndarray], box: Box | None) -> Box | None:
    """The box that `released_view` crops with; if it does not crop, the dataset's own box, if any."""
    if "trans" in centers or "joints_box" not in centers:
        return box
    low, high = np.nanmin(joints, 0), np.nanmax(joints, 0)
    # the minimum is for a single labeled joint
    return Box(center=(low + high) / 2, size=np.maximum(_ROOM * (high - low), _LEAST_EDGE))


class Model(Protocol):
    """The model to evaluate: `lidarpose.Predictor`, or any object with the joints `skeleton` and with `predict`, whose
    results have a `pose` each, None or a `Pose` of that skeleton. model: its description in scores.json, by default its
    class's name. The protocol dapt also needs `outputs` and `backend`. A network of clips, whose backend has `frames`,
    also takes `predict(clips=)` and `outputs(clip=)`."""

    skeleton: Skeleton
    model: dict[str, Any]
    backend: Any

    def predict(self, points, *, sensor_origin=None, skeleton: str | None = None, progress: bool = False): ...

    def outputs(self, clouds: list[np.ndarray], centers: np.ndarray, origin: np.ndarray | None): ...


def crop_of(person: EvalSample, setting: Setting) -> tuple[np.ndarray, Box | None]:
    """Which points (n,) bool a network gets under the protocol, and the box that they are cropped with.

    Protocol dapt uses the released code's box, clean a detector's box, which depends only on the seed and the person's
    position in the dataset. If nothing is cropped, the box is the dataset's own, if any.
    """
    sample = person.sample
    if setting.protocol == "dapt":
        is_inside, _ = released_view(person.points, sample.joints, sample.centers, sample.box)
        return is_inside, released_box(sample.joints, sample.centers, sample.box)
    if setting.kind in _OWN_CROP or setting.kind not in _CLEAN_CROPS or sample.box is None:
        return np.ones(len(person.points), bool), sample.box
    box = jittered(sample.box, np.random.default_rng([setting.seed, person.shard, person.row]))
    return box.contains(person.points), box


@dataclass(frozen=True, kw_only=True)
class EvalSetup:
    """A network and a dataset, checked: see `eval_setup`. joints: those that are scored."""

    model: Model
    dataset: EvalDataset
    setting: Setting
    joints: Skeleton

    def crop_sample(self, person: EvalSample) -> tuple[EvalSample | None, str]:
        """The person as cropped by the protocol; or None, and the reason for which the person is skipped."""
        kind, min_points = self.setting.kind, 0
        if self.setting.protocol == "dapt":
            center, min_points = DAPT[kind].center, DAPT[kind].least
            if center not in person.sample.centers:
                return None, f"people without the center {center!r}"
            if kind == "humanm3" and (person.sample.joint_labels == UNLABELED).all():
                return None, "people without a labelled joint, which their box needs"
        rows, box = crop_of(person, self.setting)
        if np.count_nonzero(rows) < min_points:
            return None, f"people of under {min_points} points, as the released code skips them"
        point_times = None if person.point_times is None else person.point_times[rows]
        return replace(person, points=person.points[rows], point_times=point_times, crop_box=box), ""

    def predict(self, samples: Sequence[EvalSample]) -> Predictions:
        """Labels and predictions of people that were cropped by `crop_sample`."""
        answers: list[dict] = [{} for _ in samples]
        answer = self._predict_clean if self.setting.protocol == "clean" else self._predict_dapt
        is_single = self._frames == 1
        rows_by_kind: dict[tuple[bool, bool], list[int]] = {}
        for k, person in enumerate(samples):
            is_known = person.sample.sensor_known and self.setting.sensor == "known"
            rows_by_kind.setdefault((is_known, is_single and person.crop_box is not None), []).append(k)
        for (is_known, _), rows in rows_by_kind.items():
            origin = np.zeros(3) if is_known else None
            for k, values in zip(rows, answer([samples[k] for k in rows], origin), strict=True):
                answers[k] = self._label_columns(samples[k]) | values
        return stack(self.joints, answers)

    def _predict_clean(self, samples: list[EvalSample], origin: np.ndarray | None) -> Iterator[dict]:
        clouds = [person.points for person in samples]
        model: Any = self.model
        name, clips = model.skeleton.name, self._clips(samples)
        # in a call either all people have a box or none; these are the boxes that cropped, not boxes made from labels
        centers = [person.crop_box.center for person in samples if person.crop_box is not None]
        newest_clouds = [newest_points(person.points, person.point_times, origin) for person in samples]
        people = self.answers(clouds, origin, np.stack(centers) if centers else None, clips, newest_clouds)
        if (
            not isinstance(people, Sequence)
            or len(people) != len(clouds)
            or not all(hasattr(person, "pose") for person in people)
        ):
            raise InputError(
                f"{model.model['name']}.predict: expected an answer for each of {len(clouds)} clouds, with a `pose` of "
                f"{name} or None, got {shorten(repr(people), 60)}: return the same as lidarpose.Predictor"
            )
        for sample, person in zip(samples, people, strict=True):
            self._check_pose(person.pose, sample)
            yield {} if person.pose is None else self._prediction_columns(person.pose, ())

    def answers(
        self,
        clouds: list[np.ndarray],
        origin: np.ndarray | None,
        box_centers: np.ndarray | None,
        clips: dict[str, Clips] | None = None,
        newest_clouds: Sequence[np.ndarray | None] | None = None,
    ) -> Any:
        """The model's answers for clouds (n, 3) m under the protocol clean. box_centers (N, 3) m, None without boxes,
        and newest_clouds, see `Predictor.predict_in`: for models that take them, but not for clips."""
        model: Any = self.model
        name = model.skeleton.name
        if hasattr(model, "predict_in") and not clips:
            return model.predict_in(
                clouds, origin, name, box_centers=box_centers, newest_clouds=newest_clouds, check_upside_down=False
            )
        return model.predict(clouds, sensor_origin=origin, skeleton=name, **(clips or {}))

    def _check_pose(self, pose: Any, person: EvalSample) -> None:
        """Raises InputError unless a model's answer is None or a pose of its skeleton with shares from 0 to 1. All
        its scored joints must be finite, or none, which is the same as None."""
        model, skeleton = self.model.model["name"], self.model.skeleton
        if pose is None:
            return
        if (
            not isinstance(pose, Pose)
            or pose.skeleton.joints != skeleton.joints
            or pose.joints.shape != (len(skeleton), 3)
        ):
            actual = type(pose).__name__
            if isinstance(pose, Pose):
                actual = f"{len(pose.skeleton)} joints of {pose.skeleton.name}"
            raise InputError(
                f"{model}.predict: expected a lidarpose.Pose with the {len(skeleton)} joints of {skeleton.name}, got "
                f"{actual}: return poses of the model's skeleton"
            )
        is_finite = np.isfinite(pose.joints[skeleton.map_to(self.joints)]).all(-1)
        if is_finite.any() and not is_finite.all():
            raise InputError(
                f"{model}.predict: expected finite joints for the person in shard {person.shard}, row {person.row}, "
                f"got {(~is_finite).sum()} of {len(is_finite)} scored ones that are not: return None for no pose"
            )
        for name, value in known_values(pose, "confidence", "visible", *PER_PERSON).items():
            if not np.all((value >= 0) & (value <= 1)):
                raise InputError(
                    f"{model}.predict: expected {name} from 0 to 1, got {np.min(value)} to {np.max(value)}"
                )

    def _predict_dapt(self, samples: list[EvalSample], origin: np.ndarray | None) -> Iterator[dict]:
        """Predicts in one pass, centered as in the released code."""
        model: Any = self.model
        batch = model.backend.batch
        answers: dict[int, dict] = {}
        starts = range(0, len(samples), batch)
        batches: Iterable = ((range(start, min(start + batch, len(samples))), {}) for start in starts)
        if clips := self._clips(samples):
            batches = ((rows, {"clip": clip}) for rows, clip in clips["clips"].batches(batch))
        for rows, clip in batches:
            batch_samples = [samples[row] for row in rows]
            centers = np.stack([person.sample.centers[DAPT[self.setting.kind].center] for person in batch_samples])
            estimates = model.outputs(
                [person.points.astype(float) for person in batch_samples], centers, origin, **clip
            )
            for k, (row, center) in enumerate(zip(rows, centers, strict=True)):
                values = self._prediction_columns(estimates, k)
                values["pred"] = values["pred"] + center
                # no pose if any joint is not finite, as in Predictor.predict: `outputs` has no other way to say so
                answers[row] = values if np.isfinite(values["pred"]).all() else {}
        yield from (answers[row] for row in range(len(samples)))

    @property
    def _frames(self) -> int:
        """Number of frames in a clip of the network, 1 for a network of single frames."""
        return getattr(getattr(self.model, "backend", None), "frames", 1)

    def can_split(self, samples: Sequence[EvalSample], person: EvalSample) -> bool:
        """Whether `person`, who comes next, can start a new chunk without changing the clips of these samples."""
        sequence = person.sample.sequence
        if self._frames == 1 or self.dataset.limit is not None or samples[-1].sample.sequence != sequence:
            return True
        sequence_samples = [eval_sample.sample for eval_sample in samples if eval_sample.sample.sequence == sequence]
        # the last run of a track may continue
        last_lengths = {sequence_samples[run[0]].track: len(run) for run in _runs(sequence_samples)}
        return all(length % self._frames == 0 for length in last_lengths.values())

    def _clips(self, samples: Sequence[EvalSample]) -> dict[str, Clips]:
        """Additional input of a network of clips: which people are successive frames, and their surroundings.

        With a limit, each person is a clip of their own, even if the frames drawn happen to be close to each other.
        """
        if self._frames == 1:
            return {}
        labeled_samples = [person.sample for person in samples]
        runs = _runs(labeled_samples) if self.dataset.limit is None else np.arange(len(labeled_samples))[:, None]
        background, neighbors = (
            [np.zeros((0, 3)) if (cloud := getattr(sample, name)) is None else cloud for sample in labeled_samples]
            for name in ("background", "neighbors")
        )
        windows = np.concatenate([clip_windows(run) for run in runs])
        return {"clips": Clips(windows=windows, background=background, neighbors=neighbors)}

    def _prediction_columns(self, estimates, index) -> dict:
        """Columns of the scored joints of a pose, or of person `index` of many."""
        joint_indices = self.model.skeleton.map_to(self.joints)
        joint_values = known_values(estimates, "confidence", "spread", "visible")
        joint_values = {name: value[index][..., joint_indices] for name, value in joint_values.items()}
        person_values = {name: value[index] for name, value in known_values(estimates, *PER_PERSON).items()}
        return joint_values | person_values | {"pred": estimates.joints[index][..., joint_indices, :]}

    def _label_columns(self, person: EvalSample) -> dict[str, Any]:
        sample, box = person.sample, person.sample.box
        joint_indices = self.dataset.skeleton.map_to(self.joints)
        true = sample.joints[joint_indices]
        return {
            **{
                name: getattr(person, name)
                for name in ("shard", "row", "condition", "poses", "family", "plain", "moving")
            },
            **{name: getattr(sample, name) for name in ("sequence", "frame", "track", "time", "distance")},
            "sensor": str(person.info.sensor),
            "hidden": 1 - person.info.visible,
            "points": len(person.points),
            "box": None if box is None else [*box.center, *box.size, box.yaw],
            "true": true,
            "labels": sample.joint_labels[joint_indices],
            "nearby": num_nearby(person.points, true),
        }


def eval_setup(
    model: Model,
    dataset: EvalDataset,
    *,
    protocol: str = "clean",
    seed: int = 0,
    skeleton: str | None = None,
    sensor_unknown: bool = False,
) -> EvalSetup:
    """Checks a network and a dataset for evaluation under a protocol.

    Raises InputError, one line, if the protocol does not fit the dataset, the dataset lacks joints of the requested
    `skeleton`, or it and the network have no joint in common.
    """
    seed = check_int("seed", seed, least=0)
    check_protocol(protocol, dataset)
    if protocol == "dapt" and not (hasattr(model, "outputs") and hasattr(model, "backend")):
        raise InputError(
            "the protocol dapt needs a model with `outputs` and `backend`, like Predictor: use protocol clean"
        )
    if protocol == "dapt" and model.model.get("tta", 1) > 1:
        raise InputError("the protocol dapt predicts each person once, as the released code does: leave tta out")
    target_skeleton = dataset.scored
    if skeleton is not None:
        target_skeleton = skeleton_of(skeleton)
        if missing_joints := [name for name in target_skeleton.joints if name not in dataset.skeleton.joints]:
            raise InputError(
                f"{dataset.name} has no {', '.join(missing_joints)}, which {target_skeleton.name} needs: its joints "
                f"are {dataset.skeleton.name}"
            )
    network_joints, excluded_joints = model.skeleton.joints, DAPT[dataset.kind].without if protocol == "dapt" else ()
    scored_joints = tuple(
        name for name in target_skeleton.joints if name in network_joints and name not in excluded_joints
    )
    if not scored_joints:
        raise InputError(
            f"{dataset.name} has the joints {', '.join(target_skeleton.joints)}, the network "
            f"{', '.join(network_joints)}: none in common"
        )
    reasons = {
        "the network has no": [name for name in target_skeleton.joints if name not in network_joints],
        "the released means leave out": [
            name for name in target_skeleton.joints if name in network_joints and name in excluded_joints
        ],
    }
    fields = ("split", "split_source", "leaks", "total", "limit", "clusters", "kind")
    setting = Setting(
        dataset=dataset.name,
        method=str(model.model["name"]),
        protocol=protocol,
        joints=scored_joints,
        not_judged="; ".join(f"{reason} {', '.join(names)}" for reason, names in reasons.items() if names),
        sensor="unknown" if sensor_unknown else "known",
        seed=seed,
        centring=DAPT[dataset.kind].centring if protocol == "dapt" else _centering(model, dataset.kind),
        crop=DAPT[dataset.kind].crop if protocol == "dapt" else _CLEAN_CROPS.get(dataset.kind, _UNBOXED),
        **{name: getattr(dataset, name) for name in fields},
    )
    return EvalSetup(model=model, dataset=dataset, setting=setting, joints=_subset(target_skeleton, scored_joints))


def _centering(model: Model, kind: str) -> str:
    """How people are centered in the protocol clean."""
    if kind not in _CLEAN_CROPS or not getattr(model, "uses_box_centers", hasattr(model, "predict_in")):
        return "points alone"
    boxed = "where uncertain the center of the displaced box"
    return f"points; top view: and {boxed}" if kind == "itop" else f"points, and {boxed}"


def _subset(skeleton: Skeleton, joints: Sequence[str]) -> Skeleton:
    """A skeleton of some joints of another, in its order. The parent of each is its nearest remaining ancestor, or else
    the first joint."""
    if tuple(joints) == skeleton.joints:
        return skeleton
    parents: list[int] = []
    for name in joints:
        parent = skeleton.parents[skeleton.index(name)]
        while parent >= 0 and skeleton.joints[parent] not in joints:
            parent = skeleton.parents[parent]
        parents.append(joints.index(skeleton.joints[parent]) if parent >= 0 else min(len(parents), 1) - 1)
    return Skeleton(name=f"{len(joints)} joints of {skeleton.name}", joints=tuple(joints), parents=tuple(parents))


def _runs(samples: Sequence[LabeledSample]) -> list[np.ndarray]:
    """Rows of each run of one person's successive frames."""
    return consecutive([(sample.sequence, sample.track) for sample in samples], [sample.frame for sample in samples])
