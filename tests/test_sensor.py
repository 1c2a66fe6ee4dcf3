import dataclasses
import json

import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.lidar.presets import SENSORS, sensor
from lidarpose.lidar.sensor import Sensor, Window
from lidarpose.lidar.sensor_file import load_sensor

ROWS = {
    "dapt64": 64, "vlp-16": 16, "vlp-32c": 32, "hdl-32e": 32, "hdl-64e": 64, "os1-64": 64, "os1-128": 128,
    "os0-128": 128, "os2-128": 128, "waymo-top": 64, "pandar64": 64, "av2": 64,
}  # fmt: skip


def test_presets_are_what_their_names_say():
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
    # two equal tables, one upside down
    assert sensor("av2").elevations == pytest.approx(-sensor("av2").elevations[::-1])


def test_unknown_name_lists_the_nearest():
    with pytest.raises(InputError, match="did you mean vlp-32c"):
        sensor("vlp32c")


def test_a_sensor_is_frozen():
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
        ({"azimuth_step": -np.pi}, "divide 2 pi"),
        ({"azimuth_offsets": np.zeros(3)}, "one a ring"),
        ({"range_min": 5.0, "range_max": 4.0}, "min < max"),
        ({"dropout": 1.0}, "dropout"),
        ({"range_sigma": -0.1}, "range_sigma"),
        ({"height": np.nan}, "height must be a finite number"),
        ({"elevations": ["x"]}, "elevations must be a list of finite angles"),
        ({"azimuth_step": "x"}, "azimuth_step must be a finite number, got 'x'"),
    ],
)
def test_bad_sensors_say_what_is_wrong(change, message):
    good = {"name": "x", "elevations": np.array([-0.1, 0.1]), "azimuth_step": np.pi / 180}
    Sensor(**good)
    with pytest.raises(InputError, match=message):
        Sensor(**{**good, **change})


def test_offsets_of_whole_columns_do_not_move_beams():
    s = dataclasses.replace(sensor("os1-128"), azimuth_offsets=np.radians(1.40625) * np.tile([3, 1, -1, -3], 32))
    assert len(s.shift_groups) == 1 and not s.azimuth_shifts.any()


def test_shift_groups_hold_each_ring_once():
    s = sensor("pandar64")
    assert np.sort(np.concatenate([rings for _, rings in s.shift_groups])).tolist() == list(range(64))
    assert np.abs(s.azimuth_shifts).max() <= s.azimuth_step / 2
    for shift, rings in s.shift_groups:
        turned = (s.azimuth_offsets[rings] - shift) / s.azimuth_step
        assert turned == pytest.approx(np.round(turned), abs=1e-3)


def test_window_holds_the_beams_between_the_bounds_and_no_others():
    s = sensor("vlp-32c")
    azimuths = s.azimuth_start + np.arange(s.columns) * s.azimuth_step
    inside = (azimuths >= 0.1) & (azimuths <= 0.2)
    rings = (s.elevations >= -0.1) & (s.elevations <= 0.05)
    w = s.window(0.1, 0.2, -0.1, 0.05)
    assert np.flatnonzero(inside).tolist() == list(range(w.column0, w.column0 + w.columns))
    assert np.flatnonzero(rings).tolist() == list(range(w.row0, w.row0 + w.rows))
    assert s.azimuths(w)[:, 0] == pytest.approx(azimuths[inside])


def test_window_over_the_seam_and_all_round():
    s = sensor("dapt64")
    w = s.window(np.pi - 0.01, np.pi + 0.01, -1, 1)
    # -pi and +pi are one column
    assert w.columns == 9 and w.column0 + 4 == s.columns and (w.row0, w.rows) == (0, 64)
    assert s.window(-4, 4, -1, 1) == Window(column0=0, columns=2649, row0=0, rows=64)
    assert s.window(0, 1e-6, 0, 1e-6).columns in (0, 1) and s.window(0, 1, 0.5, 0.6).rows == 0


def test_user_tables_that_go_wrong_are_told_in_one_line(tmp_path):
    def refused(name, content, message):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        with pytest.raises(InputError, match=message) as caught:
            sensor(path)
        assert "\n" not in str(caught.value) and str(path) in str(caught.value)

    refused("a.json", '{"elevations_deg": [1, 2], "height": 1' + "0" * 400 + "}", "height must be a finite number")
    refused("b.json", '{"elevations_deg": [1, 2], "tilt_deg": "down"}', "tilt_deg must be a number")
    refused("c.json", "[1, 2, NaN]", "number 2 is not finite")
    refused("d.json", "[" * 100_000, "is not JSON")
    refused("e.csv", '"' + "9" * 200_000 + '"', "is not CSV")
    refused("f.csv", b"1\n" * 2**23 + b"1\n", "is it a recording")
    refused("g.csv", b"", "is empty")
    refused(
        "h.json", '{"beam_altitude_angles": [1, 2], "lidar_mode": "0x10"}', "a lidar_mode such as 1024x10, got '0x10'"
    )
    refused("h.json", '{"beam_altitude_angles": [1, 2], "lidar_mode": "\u00b2x10"}', "a lidar_mode such as 1024x10")
    refused("h.json", '{"beam_altitude_angles": [1, 2], "lidar_mode": 5}', "a lidar_mode such as 1024x10, got '5'")


def test_ouster_files_of_all_ages_say_their_columns(tmp_path):
    angles, path = [16.6, 0.5, -16.6], tmp_path / "os.json"
    for content, columns in (
        ({"beam_altitude_angles": angles, "lidar_mode": "2048x10"}, 2048),
        ({"beam_intrinsics": {"beam_altitude_angles": angles}, "config_params": {"lidar_mode": "512x20"}}, 512),
        ({"beam_intrinsics": {"beam_altitude_angles": angles}, "lidar_data_format": {"columns_per_frame": 1024}}, 1024),
        ({"beam_altitude_angles": angles, "lidar_mode": "MODE_4096x5"}, 4096),
        ({"beam_altitude_angles": angles, "lidar_mode": "?", "lidar_data_format": {"columns_per_frame": 512}}, 512),
        ({"beam_altitude_angles": angles}, 1024),
    ):
        path.write_text(json.dumps(content))
        found = load_sensor(path)
        assert found.columns == columns and found.rows == 3
        assert np.degrees(found.elevations) == pytest.approx(sorted(angles))


def test_csv_files_of_any_line_end_are_read(tmp_path):
    for number, end in enumerate(("\n", "\r\n", "\r")):
        path = tmp_path / f"{number}.csv"
        path.write_bytes(end.join(["\ufeffChannel,Elevation,Azimuth", "1,10,1.0", "2,-10,-1.0", ""]).encode())
        found = load_sensor(path)
        assert np.degrees(found.elevations) == pytest.approx([-10, 10])
        assert abs(np.degrees(found.azimuth_offsets[0] - found.azimuth_offsets[1])) == pytest.approx(2)
