"""Folders, patterns and files as frames: their order, times, and what becomes of damaged ones."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

import lidarpose
from lidarpose.errors import InputError
from lidarpose.io.sources import DamagedFrame, FrameSource, IndexedRecording, Sweep, open_source

POINTS = np.arange(1, 13, dtype=np.float32).reshape(4, 3)


def saved(folder, *names):
    """A .npy file of each name, the k-th with POINTS times k + 1."""
    folder.mkdir(parents=True, exist_ok=True)
    for k, name in enumerate(names):
        with open(folder / name, "wb") as file:
            np.save(file, POINTS * (k + 1))
    return folder


def ids(source):
    return [frame.id for frame in source]


def numbered(count, times=None, damaged=()):
    """A recording of `count` frames, of which some cannot be decoded."""

    def read(i):
        if i in damaged:
            raise InputError(f"frame {i} is damaged")
        return Sweep(points=POINTS * (i + 1))

    return IndexedRecording(name="made", ids=[f"{i:03}" for i in range(count)], times=times, read=read)


def test_a_folder_is_read_by_the_numbers_of_its_names(tmp_path):
    saved(tmp_path, "frame_10.npy", "frame_2.npy", "Frame_1.npy", ".hidden.npy", "._frame_3.npy")
    (tmp_path / "frame_3.npy").mkdir()
    source = lidarpose.open_source(tmp_path)
    assert ids(source) == ["Frame_1", "frame_2", "frame_10"] and source.count == 3
    frames = list(source)
    assert [frame.index for frame in frames] == [0, 1, 2] and np.allclose([f.time for f in frames], [0, 0.1, 0.2])
    assert np.array_equal(frames[1].points, POINTS * 2.0) and frames[1].points.dtype == np.float64
    assert source.warnings == ("has no times: taken as 10 frames a second (give rate for another)",)
    assert not open_source(tmp_path, rate=20).warnings


@given(
    st.integers(0, 25),
    st.floats(0.5, 40),
    st.sets(st.integers(0, 24)),
    st.integers(1, 6),
    st.none() | st.floats(0, 1.5),
    st.none() | st.floats(1.6, 4),
    st.booleans(),
)
@settings(max_examples=60, deadline=None)
def test_the_frames_chosen_are_those_of_a_plain_filter(first, rate, damaged, every, start, end, has_times):
    times = np.cumsum(np.linspace(0.05, 0.2, 25)) + 1e9 if has_times else np.arange(25) / rate
    recording = numbered(25, times if has_times else None, damaged)
    source = FrameSource(recording, rate=rate, start=start, end=end, every=every)
    since = times - times[0] if has_times else times
    chosen = [
        i
        for i in range(first, 25)
        if (start is None or since[i] >= start) and (end is None or since[i] <= end) and i % every == 0
    ]
    frames = list(source.frames(first))
    assert [frame.index for frame in frames] == chosen
    assert [isinstance(frame, DamagedFrame) for frame in frames] == [i in damaged for i in chosen]
    assert [frame.time for frame in frames] == list(times[chosen])
    if source.count is not None:
        assert source.count == len(list(source))
