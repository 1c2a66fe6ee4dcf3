import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from lidarpose.errors import InputError
from lidarpose.lidar.presets import SENSORS, listing, load_sensor, sensor
from lidarpose.lidar.sensor import Sensor, Window

ROWS = {
    "dapt64": 64, "vlp-16": 16, "vlp-32c": 32, "hdl-32e": 32, "hdl-64e": 64, "os1-64": 64, "os1-128": 128,
    "os0-128": 128, "os2-128": 128, "waymo-top": 64, "pandar64": 64, "av2": 64,
}  # fmt: skip


def test_presets_match_sensor_data():
    assert {name: s.rows for name, s in SENSORS.items() if isinstance(s, Sensor)} == ROWS
    for name, s in SENSORS.items():
        assert s.name == name and sensor(name) is s
        if not isinstance(s, Sensor):
            continue
        assert s.columns * s.azimuth_step == pytest.approx(2 * np.pi)
        assert np.degrees(np.abs(s.elevations)).max() < 46
    assert np.degrees(sensor("dapt64").elevations[[0, -1]]) == pytest.approx([-10, 10])
    assert sensor("dapt64").height == 0.5
    assert np.degrees(sensor("waymo-top").elevations[[0, -1]]) == pytest.approx([-17.6, 2.4])
    assert np.degrees(sensor("hdl-32e").elevations).round(2)[[0, 23, 31]].tolist() == [-30.67, 0, 10.67]
    # two identical sensors, one of them upside down
    assert sensor("av2").elevations == pytest.approx(-sensor("av2").elevations[::-1])


def test_unknown_sensor_suggests_nearest_name():
    with pytest.raises(InputError, match="unknown sensor 'vlp32c'.*did you mean vlp-32c"):
        sensor("vlp32c")


def test_repr_of_sensor_is_short():
    assert repr(sensor("os1-64")) == "Sensor('os1-64', 64 rings, 1024 columns)"


def test_sensor_is_frozen():
    s = sensor("vlp-16")
    with pytest.raises(dataclasses.FrozenInstanceError):
        s.height = 2.0
    with pytest.raises(ValueError):
        s.elevations[0] = 0
    assert dataclasses.replace(s, height=2.0).height == 2.0


@pytest.mark.parametrize(
    "change, message",
    [
        ({"elevations": np.array([0.1, 0.0])}, "ascend"),
        ({"elevations": np.array([-25.0, 15.0])}, "degrees"),
        ({"elevations": np.array([])}, "at least one ring"),
        ({"elevations": np.array([0.0, np.nan])}, "finite"),
        ({"azimuth_step": 0.1}, "divide 2 pi"),
        ({"azimuth_step": 2 * np.pi / 360.05}, "divide 2 pi"),
        ({"azimuth_step": -np.pi}, "divide 2 pi"),
        ({"azimuth_offsets": np.zeros(3)}, "one per ring"),
        ({"origin_heights": np.zeros(3)}, "one per ring"),
        ({"ring_lags": np.zeros(3)}, "one per ring"),
        ({"ring_lags": [0.0, 1.0]}, r"ring_lags must be in \[0, 1\), got 0 to 1"),
        ({"turn_time": 0.0}, "turn_time must be above 0 s"),
        ({"origin_heights": [0.0, np.nan]}, "origin_heights must be a list of finite heights in meters"),
        ({"range_min": 5.0, "range_max": 4.0}, "min < max"),
        ({"dropout": 1.0}, "dropout"),
        ({"range_sigma": -0.1}, "range_sigma"),
        ({"height": np.nan}, "height must be a finite number"),
        ({"elevations": ["x"]}, "elevations must be a list of finite angles"),
        ({"azimuth_step": "x"}, "azimuth_step must be a finite number, got 'x'"),
    ],
)
def test_sensor_rejects_invalid_fields(change, message):
    good = {"name": "x", "elevations": np.array([-0.1, 0.1]), "azimuth_step": np.pi / 180}
    Sensor(**good)
    with pytest.raises(InputError, match=message):
        Sensor(**{**good, **change})


def test_azimuth_offsets_of_whole_columns_do_not_shift_beams():
    s = dataclasses.replace(sensor("os1-128"), azimuth_offsets=np.radians(1.40625) * np.tile([3, 1, -1, -3], 32))
    assert len(s.shift_groups) == 1 and not s.azimuth_shifts.any()


def test_shift_groups_hold_each_ring_once():
    s = sensor("pandar64")
    assert np.sort(np.concatenate([rings for _, rings in s.shift_groups])).tolist() == list(range(64))
    assert np.abs(s.azimuth_shifts).max() <= s.azimuth_step / 2
    for shift, rings in s.shift_groups:
        turned = (s.azimuth_offsets[rings] - shift) / s.azimuth_step
        assert turned == pytest.approx(np.round(turned), abs=1e-3)


def test_window_contains_exactly_beams_between_bounds():
    s = sensor("vlp-32c")
    azimuths = s.azimuth_start + np.arange(s.columns) * s.azimuth_step
    inside = (azimuths >= 0.1) & (azimuths <= 0.2)
    rings = (s.elevations >= -0.1) & (s.elevations <= 0.05)
    w = s.window(0.1, 0.2, -0.1, 0.05)
    assert np.flatnonzero(inside).tolist() == list(range(w.column0, w.column0 + w.columns))
    assert np.flatnonzero(rings).tolist() == list(range(w.row0, w.row0 + w.rows))
    assert s.azimuths(w)[:, 0] == pytest.approx(azimuths[inside])


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_window_matches_loop_for_shifted_rings(seed):
    s, rng = sensor("pandar64"), np.random.default_rng(seed)
    left, width = rng.uniform(-3, 2), rng.uniform(0, 0.1)
    low, high = np.sort(rng.choice(s.elevations, 2))
    w = s.window(left, left + width, low, high)
    assert s.elevations[w.row0] == low and s.elevations[w.row0 + w.rows - 1] == high
    columns = s.azimuth_start + np.arange(s.columns) * s.azimuth_step
    azimuths = columns[:, None] + s.azimuth_shifts
    inside = np.flatnonzero(((azimuths >= left) & (azimuths <= left + width)).any(1))
    assert set(inside) <= set(range(w.column0, w.column0 + w.columns)) and w.columns <= len(inside) + 2
    np.testing.assert_allclose(s.azimuths(w), azimuths[w.column0 :][: w.columns, w.row0 : w.row0 + w.rows])


def test_origins_of_lags_start_at_smallest_lag():
    s = Sensor(name="x", elevations=[-0.1, 0.0, 0.1], azimuth_step=np.pi / 180, ring_lags=[0.25, 0.75, 0.25])
    assert s.lag == 0.5
    assert [(share, rings.tolist()) for _, share, _, rings in s.origins] == [(0, [0, 2]), (1, [1])]


def test_window_across_seam_and_full_turn():
    s = sensor("dapt64")
    w = s.window(np.pi - 0.01, np.pi + 0.01, -1, 1)
    # -pi and +pi are one column
    assert w.columns == 9 and w.column0 + 4 == s.columns and (w.row0, w.rows) == (0, 64)
    assert s.window(-4, 4, -1, 1) == Window(column0=0, columns=2649, row0=0, rows=64)
    assert s.window(0, 1e-6, 0, 1e-6).columns == 0 and s.window(0, 1, 0.5, 0.6).rows == 0


# --- sensor files of the user, list of presets

ANGLES = [15.0, 5.0, -5.0, -15.0]


def written(path, content):
    content = content if isinstance(content, str | bytes) else json.dumps(content)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


OUSTER = {"beam_altitude_angles": ANGLES, "beam_azimuth_angles": [4.2, 1.4, -1.4, -4.2]}
CSV = "\ufeffLaser id,Elevation,Azimuth\n1,15,1.0\n2,5,2.0\n3,-5,3.0\n4,-15,4.0\n"


@pytest.mark.parametrize(
    ("suffix", "content", "columns", "offsets"),
    [
        ("json", ANGLES, 1800, None),
        ("json", {"elevations_deg": ANGLES}, 1800, None),
        ("csv", "15\n5\n-5\n-15\n", 1800, None),
        ("csv", "# made by hand\nelevation (deg)\n15\n5\n-5\n-15\n", 1800, None),
        *[("csv", CSV.replace("\n", end), 1800, [-4.0, -3.0, -2.0, -1.0]) for end in ("\n", "\r\n", "\r")],
        # metadata of Ouster sensors in old and new formats
        ("json", OUSTER, 1024, [4.2, 1.4, -1.4, -4.2]),
        ("json", OUSTER | {"lidar_mode": "2048x10"}, 2048, [4.2, 1.4, -1.4, -4.2]),
        ("json", OUSTER | {"lidar_mode": "MODE_4096x5"}, 4096, [4.2, 1.4, -1.4, -4.2]),
        ("json", {"beam_intrinsics": OUSTER, "config_params": {"lidar_mode": "512x20"}}, 512, [4.2, 1.4, -1.4, -4.2]),
        ("json", {"a": {"beam_altitude_angles": ANGLES}, "b": {"columns_per_frame": 1024}}, 1024, None),
        ("json", OUSTER | {"lidar_mode": "?", "b": {"columns_per_frame": 512}}, 512, [4.2, 1.4, -1.4, -4.2]),
    ],
)
def test_load_sensor_reads_json_and_csv_files(tmp_path, suffix, content, columns, offsets):
    path = written(tmp_path / f"mine.{suffix}", content)
    table = load_sensor(path)
    np.testing.assert_allclose(np.degrees(table.elevations), sorted(ANGLES))
    assert table.name == "mine" and table.columns == columns
    if offsets is None:
        assert table.azimuth_offsets is None
    else:
        np.testing.assert_allclose(np.degrees(table.azimuth_offsets), offsets)
    # `sensor` reads the file too, as on the command line
    np.testing.assert_array_equal(sensor(str(path)).elevations, table.elevations)


@pytest.mark.parametrize(
    ("named", "sign"),
    [("azimuth_offset", 1), ("azimuth_offset_deg", 1), ("Azimuth offsets (deg)", 1), ("azimuth-offsets-deg", 1)]
    + [("azimuth", -1), ("azimuth_deg", -1), ("Horizontal", -1)],
)
def test_load_sensor_accepts_csv_names_of_offsets(tmp_path, named, sign):
    table = load_sensor(written(tmp_path / "a.csv", f"laser,elevation_deg,{named}\n1,-1,5\n2,0,3\n3,1,2\n"))
    np.testing.assert_allclose(np.degrees(table.azimuth_offsets), np.multiply(sign, [5, 3, 2]))


def test_load_sensor_json_sets_all_fields(tmp_path):
    given = {
        "name": "mine", "elevations_deg": ANGLES, "azimuth_offsets_deg": [0, 1, 2, 3], "columns": 720,
        "range_min": 1.0, "range_max": 50.0, "range_sigma": 0.03, "dropout": 0.1, "height": 2.5, "tilt_deg": 20.0,
    }  # fmt: skip
    table = load_sensor(written(tmp_path / "x.json", given))
    assert (table.name, table.columns, table.range_min, table.range_max) == ("mine", 720, 1.0, 50.0)
    assert (table.range_sigma, table.dropout, table.height) == (0.03, 0.1, 2.5)
    assert np.degrees(table.tilt) == pytest.approx(20)
    np.testing.assert_allclose(np.degrees(table.azimuth_offsets), [3, 2, 1, 0])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", "{", "is not JSON"),
        ("a.json", "[]", "has no elevations"),
        ("a.json", {"beams": 3}, "has no beams"),
        ("a.json", "3", "has no beams"),
        ("a.json", ["up", "down"], "list of numbers"),
        ("a.json", [[1, 2], [3, 4]], "list of finite numbers"),
        ("a.json", [0, 95.0], "within .*90 degrees"),
        ("a.json", np.radians(np.linspace(-25, 15, 32)).tolist(), "seem to be in radians"),
        ("a.json", {"elevations_deg": ANGLES, "azimuth_offsets_deg": [1, 2]}, "4 elevations and 2 azimuth offsets"),
        ("a.json", {"elevations_deg": ANGLES, "columns": 0}, "columns must be"),
        ("a.json", {"elevations_deg": ANGLES, "azimuth_offset_deg": ANGLES}, "unknown key .* azimuth_offsets_deg"),
        ("a.json", {"elevations_deg": ANGLES, "height": -5}, "height must be above 0 m"),
        ("a.json", {"elevations_deg": ANGLES, "tilt_deg": 400}, "within .*90 degrees, got 400"),
        ("a.json", {"elevations_deg": ANGLES, "range_max": "far"}, "range_max must be a number"),
        ("a.json", {"elevations_deg": ANGLES, "tilt_deg": "down"}, "tilt_deg must be a number"),
        ("a.json", {"elevations_deg": ANGLES, "name": "a/b"}, "name must not contain '/'.*got 'a/b'"),
        ("a.json", {"elevations_deg": ANGLES, "range_min": 9.0, "range_max": 1.0}, "min < max"),
        ("a.csv", "elevation,azimuths\n1,2\n3,4\n", "unknown column 'azimuths': name it azimuth_offset"),
        ("a.csv", "\n\n", "no rows"),
        ("a.csv", "1,2\n3,4\n", "no header"),
        ("a.csv", "laser,azimuth\n1,2\n", "no column named elevation"),
        ("a.csv", "elevation\n1\nup\n", "number of degrees in every row"),
        ("a.csv", "azimuth,elevation\n1,2\n1\n", "number of degrees in every row"),
        pytest.param(
            "a.json",
            '{"elevations_deg": [1, 2], "height": 1' + "0" * 400 + "}",
            "height must be a finite number",
            id="long number",
        ),
        ("a.json", "[1, 2, NaN]", "number 2 is not finite"),
        pytest.param("a.json", "[" * 100_000, "is not JSON", id="deep"),
        pytest.param("a.csv", '"' + "9" * 200_000 + '"', "is not CSV", id="long cell"),
        pytest.param("a.csv", b"1\n" * 2**23 + b"1\n", "is it a recording", id="large"),
        ("a.csv", b"", "is empty"),
        *[
            ("a.json", OUSTER | {"lidar_mode": mode}, f"a lidar_mode such as 1024x10, got '{mode}'")
            for mode in ("0x10", "\u00b2x10", 5)
        ],
    ],
)
def test_load_sensor_rejects_invalid_files(tmp_path, name, content, message):
    path = written(tmp_path / name, content)
    with pytest.raises(InputError, match=message) as caught:
        load_sensor(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_missing_sensor_file_raises(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        sensor(str(tmp_path / "none.json"))


@settings(max_examples=60, deadline=None)
@given(st.binary(min_size=1, max_size=200), st.sampled_from([".json", ".csv"]))
def test_load_sensor_raises_only_input_error(tmp_path_factory, content, suffix):
    path = tmp_path_factory.mktemp("t") / f"x{suffix}"
    path.write_bytes(content)
    try:
        table = load_sensor(path)
    except InputError as error:
        assert "\n" not in str(error)
    else:
        assert np.isfinite(table.elevations).all()


def test_listing_names_all_sensors():
    lines = listing()
    assert len(lines) == 1 + len(SENSORS) >= 13 and {line.split()[0] for line in lines[1:]} == set(SENSORS)
    assert all(len(line) < 100 for line in lines)


def test_changed_sensor_file_is_read_again(tmp_path, monkeypatch):
    path = written(tmp_path / "mine.json", ANGLES)
    assert sensor(path).rows == 4 and sensor(path) is sensor(path)
    written(path, [*ANGLES, 25.0])
    assert sensor(path).rows == 5
    # a file of the same name in another folder
    (tmp_path / "other").mkdir()
    written(tmp_path / "other" / "mine.json", ANGLES[:3])
    for folder, rows in ((tmp_path, 5), (tmp_path / "other", 3)):
        monkeypatch.chdir(folder)
        assert sensor("mine.json").rows == rows
