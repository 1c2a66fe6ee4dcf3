"""Sensors from the user's files, and the list of those that ship."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarpose.errors import InputError
from lidarpose.lidar.presets import SENSORS, listing, sensor
from lidarpose.lidar.sensor_file import load_sensor

ANGLES = [15.0, 5.0, -5.0, -15.0]


def written(path, content):
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.json", ANGLES),
        ("b.json", {"elevations_deg": ANGLES}),
        ("c.json", {"beam_altitude_angles": ANGLES, "beam_azimuth_angles": [4.2, 1.4, -1.4, -4.2]}),
        (
            "d.json",
            {"beam_intrinsics": {"beam_altitude_angles": ANGLES}, "config_params": {"lidar_mode": "512x10"}},
        ),
        ("e.csv", "15\n5\n-5\n-15\n"),
        ("f.csv", "Laser id,Elevation,Azimuth\n1,15,1.0\n2,5,2.0\n3,-5,3.0\n4,-15,4.0\n"),
        ("g.csv", "# made by hand\nelevation (deg)\n15\n5\n-5\n-15\n"),
    ],
)
def test_tables_are_read_in_any_order_of_lasers(tmp_path, name, content):
    found = load_sensor(written(tmp_path / name, content))
    np.testing.assert_allclose(np.degrees(found.elevations), sorted(ANGLES))
    # every Ouster sensor has 512 columns or their double, once more or twice
    assert found.name == name[0] and found.columns == {"c.json": 1024, "d.json": 512}.get(name, 1800)
    if name in ("c.json", "f.csv"):
        offsets = {"c.json": [4.2, 1.4, -1.4, -4.2], "f.csv": [-4.0, -3.0, -2.0, -1.0]}[name]
        np.testing.assert_allclose(np.degrees(found.azimuth_offsets), offsets)
    # the same through the name, as on the command line
    np.testing.assert_array_equal(sensor(str(tmp_path / name)).elevations, found.elevations)


@pytest.mark.parametrize(
    ("named", "sign"),
    [("azimuth_offset", 1), ("azimuth_offset_deg", 1), ("Azimuth offsets (deg)", 1), ("azimuth-offsets-deg", 1)]
    + [("azimuth", -1), ("azimuth_deg", -1), ("Horizontal", -1)],
)
def test_offsets_of_a_csv_by_any_of_their_names(tmp_path, named, sign):
    found = load_sensor(written(tmp_path / "a.csv", f"laser,elevation_deg,{named}\n1,-1,5\n2,0,3\n3,1,2\n"))
    np.testing.assert_allclose(np.degrees(found.azimuth_offsets), np.multiply(sign, [5, 3, 2]))


def test_the_own_form_sets_every_field(tmp_path):
    given = {
        "name": "mine", "elevations_deg": ANGLES, "azimuth_offsets_deg": [0, 1, 2, 3], "columns": 720,
        "range_min": 1.0, "range_max": 50.0, "range_sigma": 0.03, "dropout": 0.1, "height": 2.5, "tilt_deg": 20.0,
    }  # fmt: skip
    found = load_sensor(written(tmp_path / "x.json", given))
    assert (found.name, found.columns, found.range_min, found.range_max) == ("mine", 720, 1.0, 50.0)
    assert (found.range_sigma, found.dropout, found.height) == (0.03, 0.1, 2.5)
    assert np.degrees(found.tilt) == pytest.approx(20)
    np.testing.assert_allclose(np.degrees(found.azimuth_offsets), [3, 2, 1, 0])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", "{", "is not JSON"),
        ("a.json", "[]", "holds no elevations"),
        ("a.json", {"beams": 3}, "holds no beams"),
        ("a.json", "3", "holds no beams"),
        ("a.json", ["up", "down"], "list of numbers"),
        ("a.json", [[1, 2], [3, 4]], "list of finite numbers"),
        ("a.json", "[1, NaN]", "list of finite numbers"),
        ("a.json", [0, 95.0], "within .*90 degrees"),
        ("a.json", np.radians(np.linspace(-25, 15, 32)).tolist(), "seem to be radians"),
        ("a.json", {"elevations_deg": ANGLES, "azimuth_offsets_deg": [1, 2]}, "4 elevations and 2 azimuth offsets"),
        ("a.json", {"elevations_deg": ANGLES, "columns": 0}, "columns must be"),
        ("a.json", {"elevations_deg": ANGLES, "azimuth_offset_deg": ANGLES}, "unknown key .* azimuth_offsets_deg"),
        ("a.json", {"elevations_deg": ANGLES, "height": -5}, "height must be above 0 m"),
        ("a.json", {"elevations_deg": ANGLES, "tilt_deg": 400}, "within .*90 degrees, got 400"),
        ("a.json", {"elevations_deg": ANGLES, "range_max": "far"}, "range_max must be a number"),
        ("a.json", {"elevations_deg": ANGLES, "range_min": 9.0, "range_max": 1.0}, "min < max"),
        ("a.csv", "elevation,azimuths\n1,2\n3,4\n", "unknown column 'azimuths': name it azimuth_offset"),
        ("a.csv", "\n\n", "no rows"),
        ("a.csv", "1,2\n3,4\n", "no header"),
        ("a.csv", "laser,azimuth\n1,2\n", "no column named elevation"),
        ("a.csv", "elevation\n1\nup\n", "number of degrees in every row"),
        ("a.csv", "azimuth,elevation\n1,2\n1\n", "number of degrees in every row"),
    ],
)
def test_wrong_tables_are_told_in_one_line(tmp_path, name, content, message):
    path = written(tmp_path / name, content)
    with pytest.raises(InputError, match=message) as caught:
        load_sensor(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_missing_table_is_named(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        sensor(str(tmp_path / "none.json"))
    with pytest.raises(InputError, match="unknown sensor 'os1-129'.*os1-128"):
        sensor("os1-129")


@settings(max_examples=60, deadline=None)
@given(st.binary(min_size=1, max_size=200), st.sampled_from([".json", ".csv"]))
def test_no_bytes_make_it_fail_otherwise(tmp_path_factory, content, suffix):
    path = tmp_path_factory.mktemp("t") / f"x{suffix}"
    path.write_bytes(content)
    try:
        found = load_sensor(path)
    except InputError as error:
        assert "\n" not in str(error)
    else:
        assert np.isfinite(found.elevations).all()


def test_the_list_names_all_sensors():
    lines = listing()
    assert len(lines) == 1 + len(SENSORS) >= 13 and {line.split()[0] for line in lines[1:]} == set(SENSORS)
    assert all(len(line) < 100 for line in lines)


def test_a_table_that_has_changed_is_read_again(tmp_path, monkeypatch):
    path = written(tmp_path / "mine.json", ANGLES)
    assert sensor(path).rows == 4 and sensor(path) is sensor(path)
    written(path, [*ANGLES, 25.0])
    assert sensor(path).rows == 5
    # of the same name in another folder
    (tmp_path / "other").mkdir()
    written(tmp_path / "other" / "mine.json", ANGLES[:3])
    for folder, rows in ((tmp_path, 5), (tmp_path / "other", 3)):
        monkeypatch.chdir(folder)
        assert sensor("mine.json").rows == rows
