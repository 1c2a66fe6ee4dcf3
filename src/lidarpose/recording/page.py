"""The HTML page of a recording: an interactive 3D player of its people, frame by frame."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lidarpose.arrays import evenly_spaced
from lidarpose.errors import counted
from lidarpose.geometry import transform_points
from lidarpose.io.sources import Frame, FrameSource
from lidarpose.recording.coordinates import FixedFrame
from lidarpose.recording.picture import in_fixed_frame, nearest_points
from lidarpose.skeleton import Skeleton
from lidarpose.viz.bird_eye import ScanPanel
from lidarpose.viz.html import render_report
from lidarpose.viz.person_view import joined_poses

# maximum number of frames shown, and of points per person and frame
_MOST_FRAMES, _PERSON_POINTS = 300, 200
# number of frames whose points show the surroundings, and margin around boxes of people that is left out, m
_SURROUNDINGS, _NEAR = 4, 0.3
# duration of a frame in ms if unknown; minimum and maximum duration
_STEP, _STEPS = 100.0, (30.0, 1000.0)


@dataclass
class _Track:
    """frames: number of frames with a pose; first, last: their times, s, or frame numbers if times are unknown; way:
    horizontal length of the path, m; place: last position (2,) m."""

    frames: int
    first: float
    last: float
    way: float
    place: np.ndarray


class RecordingPage:
    """Collects the people of each line of a result, in the fixed frame; long recordings are subsampled."""

    def __init__(self) -> None:
        self._fixed: FixedFrame | None = None
        self._lines: list[tuple[dict[str, Any], np.ndarray, list[dict[str, Any]]]] = []
        self._count, self._every = 0, 1
        self._tracks: dict[int, _Track] = {}

    def add(self, line: dict[str, Any]) -> None:
        if line["error"] is not None:
            return
        # the up direction may have been estimated
        self._fixed = self._fixed or FixedFrame(line["up"], level=True)
        T_fixed_sensor, people, _ = in_fixed_frame(line, self._fixed)
        if self._count % self._every == 0:
            about = {name: line[name] for name in ("frame", "time")}
            self._lines.append((about, T_fixed_sensor, people))
        self._count += 1
        if len(self._lines) > _MOST_FRAMES:
            self._lines, self._every = self._lines[::2], 2 * self._every
        time = line["frame"] if line["time"] is None else line["time"]
        for person in people:
            if person["track"] is not None and person["joints"] is not None:
                self._follow(person["track"], person["joints"][:, :2].mean(0), time)

    def _follow(self, id: int, place: np.ndarray, time: float) -> None:
        track = self._tracks.setdefault(id, _Track(0, time, time, 0.0, place))
        track.way += float(np.linalg.norm(place - track.place))
        track.frames, track.last, track.place = track.frames + 1, time, place

    def render(self, source: FrameSource, skeleton: Skeleton, *, title: str) -> bytes:
        """The HTML page; reads the source again for the points of the frames shown."""
        shown = {about["frame"]: k for k, (about, _, _) in enumerate(self._lines)}
        is_surroundings = set(evenly_spaced(len(shown), _SURROUNDINGS).tolist())
        panels: dict[int, ScanPanel] = {}
        surroundings: list[np.ndarray] = []
        for frame in source.frames(min(shown, default=0), only=shown):
            if not isinstance(frame, Frame):
                continue
            k = shown[frame.index]
            about, T_fixed_sensor, people = self._lines[k]
            points = transform_points(T_fixed_sensor, frame.points)
            near_points, is_far = self._of_people(points, people)
            panels[k] = self._panel(about, near_points, people, skeleton)
            if k in is_surroundings:
                surroundings.append(points[is_far])
        panel = ScanPanel(
            points=np.concatenate([*surroundings, np.zeros((0, 3))]),
            frames=[panels[k] for k in sorted(panels)],
            step=self._step(),
            label=f"{counted(len(panels), 'frame')} of {self._count:,}",
        )
        start = self._start()
        unit = ", s" if any(about["time"] is not None for about, _, _ in self._lines) else ", frame"
        rows = [
            {"track": id, "frames": x.frames}
            | {f"from{unit}": x.first - start, f"to{unit}": x.last - start, "way, m": x.way}
            for id, x in sorted(self._tracks.items())
        ]
        return render_report([], title=title, summary=rows, scans=[panel]).encode("utf-8", "replace")

    def _of_people(self, points: np.ndarray, people: list[dict[str, Any]]) -> tuple[np.ndarray, np.ndarray]:
        """A subsample (m, 3) m of the points inside the boxes of people, and (n,) bool: which of the points (n, 3) are
        outside all boxes and their margins. All points of a crop, whose person has no box, are the person's; people
        who were added by smoothing have no box either, and no points."""
        seen = [person for person in people if not person["filled"] or person["box"] is not None]
        if any(person["box"] is None for person in seen):
            return points[evenly_spaced(len(points), _PERSON_POINTS)], np.zeros(len(points), bool)
        is_far, clouds = np.ones(len(points), bool), [np.zeros((0, 3))]
        for person in seen:
            is_far &= ~person["box"].contains(points, margin=_NEAR)
            own_points = points[person["box"].contains(points)]
            if person["joints"] is not None:
                own_points = nearest_points(own_points, person["joints"], person["num_points"])
            clouds.append(own_points[evenly_spaced(len(own_points), _PERSON_POINTS)])
        return np.concatenate(clouds), is_far

    def _panel(
        self, about: dict[str, Any], points: np.ndarray, people: list[dict[str, Any]], skeleton: Skeleton
    ) -> ScanPanel:
        posed = [person for person in people if person["joints"] is not None]
        time = f"frame {about['frame']}" if about["time"] is None else f"{about['time'] - self._start():.2f} s"
        return ScanPanel(
            points=points,
            boxes=[person["box"] for person in people if person["box"] is not None],
            poses=joined_poses([(person["joints"], person["confidence"]) for person in posed], skeleton),
            names=[str(person["id"] if person["track"] is None else person["track"]) for person in posed],
            label=f"{time}, {counted(len(people), 'person', 'people')}",
        )

    def _start(self) -> float:
        """Time of the first frame shown, which the page counts from, s: times may be those of a clock; 0 if unknown."""
        return next((about["time"] for about, _, _ in self._lines if about["time"] is not None), 0.0)

    def _step(self) -> float:
        """Time between two shown frames, ms."""
        times = np.array([about["time"] for about, _, _ in self._lines if about["time"] is not None])
        return float(np.clip(1e3 * np.median(np.diff(times)), *_STEPS)) if len(times) > 1 else _STEP
