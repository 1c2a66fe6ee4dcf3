"""Point cloud formats: round trips, files of other programs, and bad input reported in one line."""

import gzip
import io
import os
import struct
import subprocess
import sys

import laspy
import numpy as np
import pandas as pd
import pytest
from hostile_files import (
    POINTS,
    las,
    laz_of_chunks,
    lzf_body,
    npy,
    npy_header,
    npz,
    pcd_header,
    ply_header,
    refusal,
    zipped,
)
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from lidarpose.errors import InputError, MissingExtra
from lidarpose.io.files import check_unpacked
from lidarpose.io.point_cloud import SUFFIXES, Cloud, read_points
from lidarpose.io.text import parse_text

float32_points = hnp.arrays(
    np.float32,
    st.tuples(st.integers(1, 20), st.just(4)),
    elements=st.floats(-1e6, 1e6, width=32, allow_subnormal=False),
)
float64_points = hnp.arrays(
    np.float64, st.tuples(st.integers(1, 20), st.just(3)), elements=st.floats(-1e7, 1e7, allow_subnormal=False)
)


def read(folder, name, content, **options) -> Cloud:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_points(path, **options)


def same(cloud, expected=POINTS, fields=None, *, rtol=0.0):
    assert cloud.points.dtype == np.float64 and cloud.points.flags.c_contiguous
    np.testing.assert_allclose(cloud.points, np.asarray(expected, float)[:, :3], rtol=rtol, atol=0)
    assert fields is None or cloud.fields == fields


ELEMENTS = {
    "f": st.floats(-1e6, 1e6, width=32, allow_subnormal=False),
    "i": st.integers(-128, 127),
    "u": st.integers(0, 255),
}
PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"double": "f8", "int64": "i8", "uint64": "u8", "float32": "f4"},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("clouds")


# ---- round trips


TYPES = ["<f4", "<f8", "i1", "<i2", "<i4", "<i8", "u1", "<u2", "<u4", "<u8"]


@pytest.mark.long
@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
@settings(max_examples=40, deadline=None)
@given(data=st.data(), names=st.permutations(["x", "Y", "z", "ring", "_"]), count=st.integers(1, 20))
def test_read_pcd_any_types_and_order(folder, encoding, data, names, count):
    types = {name: data.draw(st.sampled_from(TYPES)) for name in names}
    columns = {name: data.draw(hnp.arrays(kind, (count,), elements=ELEMENTS[kind[-2]])) for name, kind in types.items()}
    rows = np.rec.fromarrays(columns.values(), dtype=[(f"c{i}", kind) for i, kind in enumerate(types.values())])
    header = pcd_header(
        " ".join(names),
        " ".join(kind[-1] for kind in types.values()),
        " ".join(kind[-2].upper() for kind in types.values()),
        "1 1 1 1 1",
        count,
        encoding,
    )
    content = {
        "ascii": lambda: "".join(" ".join(map(repr, row)) + "\n" for row in rows.tolist()).encode(),
        "binary": rows.tobytes,
        "binary_compressed": lambda: lzf_body(b"".join(column.tobytes() for column in columns.values())),
    }[encoding]()
    expected = np.stack([columns[name] for name in "xYz"], -1)
    same(read(folder, f"{encoding}.pcd", header + content), expected, tuple(names))


@pytest.mark.long
@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
@settings(max_examples=40, deadline=None)
@given(data=st.data(), names=st.permutations(["x", "y", "Z", "red"]), count=st.integers(1, 20))
def test_read_ply_any_types_and_order(folder, encoding, data, names, count):
    kinds = {name: data.draw(st.sampled_from(sorted(PLY_TYPES))) for name in names}
    columns = {
        name: data.draw(hnp.arrays(PLY_TYPES[kind], (count,), elements=ELEMENTS[PLY_TYPES[kind][0]]))
        for name, kind in kinds.items()
    }
    order = ">" if "big" in encoding else "<"
    dtype = [(f"c{i}", order + PLY_TYPES[kind]) for i, kind in enumerate(kinds.values())]
    rows = np.rec.fromarrays(columns.values(), dtype=dtype)
    header = ply_header(count, encoding, names="").replace(
        b"end_header", "".join(f"property {kind} {name}\n" for name, kind in kinds.items()).encode() + b"end_header"
    )
    text = "".join(" ".join(map(repr, row)) + "\n" for row in rows.tolist())
    content = text.encode() if encoding == "ascii" else rows.tobytes()
    same(read(folder, f"{encoding}.ply", header + content), np.stack([columns[n] for n in "xyZ"], -1), tuple(names))


@pytest.mark.parametrize("packed", [False, True])
@settings(max_examples=40, deadline=None)
@given(
    points=hnp.arrays(np.int32, st.tuples(st.integers(1, 20), st.just(3)), elements=st.integers(-(2**20), 2**20)),
    kind=st.integers(0, 10),
    shift=st.tuples(*[st.sampled_from([0.0, 5_414_000.0, -0.5])] * 3),
)
def test_read_las_and_laz_all_point_formats(folder, packed, points, kind, shift):
    version = "1.2" if kind < 4 else "1.4"
    expected = points * 1e-3 + np.array(shift)
    content = las(expected, version=version, kind=kind, packed=packed, shift=shift)
    # the suffix does not determine the compression
    for name in ("a.las", "a.LAZ"):
        cloud = read(folder, name, content)
        np.testing.assert_allclose(cloud.points, expected, rtol=0, atol=1e-9)
    has = set(laspy.PointFormat(kind).dimension_names) & {"classification", "gps_time", "red", "green", "blue"}
    assert cloud.fields[:4] == ("x", "y", "z", "intensity") and set(cloud.fields[4:]) == has


@pytest.mark.parametrize("sizes", [(3, 1, 2), (6,)])
def test_read_laz_of_chunks_of_different_sizes(folder, sizes):
    points = np.concatenate([POINTS, POINTS + 5])
    content = laz_of_chunks(points, sizes)
    np.testing.assert_allclose(read(folder, "a.laz", content).points, points[:, :3], atol=6e-4)
    (table,) = struct.unpack_from("<q", content, struct.unpack_from("<I", content, 96)[0])
    # a table that is not in the file, or has more chunks than bytes
    for damaged in (content[:table], with_bytes(content, table + 4, struct.pack("<I", 10**9))):
        refusal(read, folder, "a.laz", damaged, words=["damaged or cut off"])


@pytest.mark.parametrize("place, number", [(-2, 0), (2, 0), (2, 21)])
def test_read_laz_checks_items_before_unpacking(folder, capfd, place, number):
    """lazrs prints a panic for points of impossible items."""
    content = las(packed=True)
    items = content.index(b"laszip encoded") - 2 + 54 + 34
    refusal(read, folder, "a.laz", with_bytes(content, items + place, struct.pack("<H", number)), words=["damaged"])
    assert capfd.readouterr().err == ""


def test_read_laz_needs_extra_and_las_does_not(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "lazrs", None)
    same(read(folder, "a.las", las()))
    with pytest.raises(MissingExtra, match=r'"\.\[recordings\]"'):
        read(folder, "a.laz", las(packed=True))


# files written by pypcd4 1.5 and trimesh 5.2
_PYPCD4 = (
    "VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {0}\nHEIGHT 1\n"
    "VIEWPOINT 0.0 0.0 0.0 1.0 0.0 0.0 0.0\nPOINTS {0}\nDATA {1}\n"
)
_TRIMESH = (
    "ply\nformat {} 1.0\ncomment https://github.com/mikedh/trimesh\nelement vertex 3\nproperty float x\n"
    "property float y\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
)
OTHER_WRITERS = {
    "pypcd4 ascii.pcd": _PYPCD4.format(3, "ascii").encode() + b"1.5000000000 -2.2500000000 0.1250000000 7.0000000000\n"
    b"10.0000000000 20.0000000000 -1.0000000000 8.0000000000\n3.0000000000 4.0000000000 5.0000000000 9.0000000000\n",
    "pypcd4 compressed.pcd": _PYPCD4.format(12, "binary_compressed").encode()
    + bytes.fromhex(
        "3e000000c00000000c0000c03f000020410000404000e01c0b0410c00000a0202f0080202fe01b0b01003e202b00bf2033202fe01b0b00e04027205f00102003e0170b011041"
    ),
    "trimesh ascii.ply": _TRIMESH.format("ascii").encode()
    + b"1.50000000 -2.25000000 0.12500000\n10.00000000 20.00000000 -1.00000000\n"
    b"3.00000000 4.00000000 5.00000000\n3 0 1 2\n",
    "trimesh binary.ply": _TRIMESH.format("binary_little_endian").encode()
    + POINTS[:, :3].tobytes()
    + struct.pack("<B3i", 3, 0, 1, 2),
}


@pytest.mark.parametrize("name", OTHER_WRITERS)
def test_read_points_reads_files_of_other_writers(folder, name):
    cloud = read(folder, name, OTHER_WRITERS[name])
    same(cloud, np.tile(POINTS, (len(cloud.points) // 3, 1)))
    assert cloud.num_dropped == 0 and cloud.warnings == ()


@settings(max_examples=40, deadline=None)
@given(points=float32_points, order=st.sampled_from("<>"), newline=st.sampled_from(["\n", "\r\n", "\r"]))
def test_read_ply_byte_orders_and_line_ends(folder, points, order, newline):
    # the first byte of the data may be a newline character
    points[0, 0] = np.frombuffer(b"\n\r\n?", order + "f4")[0]
    form = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    content = ply_header(len(points), form, newline=newline) + points.astype(order + "f4").tobytes()
    same(read(folder, "order.ply", content), points, ("x", "y", "z", "i"))


@settings(max_examples=40, deadline=None)
@given(points=float64_points, fortran=st.booleans())
def test_read_npy_and_npz_are_exact(folder, points, fortran):
    points = np.asfortranarray(points) if fortran else points
    same(read(folder, "a.npy", npy(points)), points)
    same(read(folder, "a.npz", npz(points=points, labels=np.zeros((9, 3)))), points)


@settings(max_examples=60, deadline=None)
@given(
    points=float64_points,
    separator=st.sampled_from([",", ", ", ";", " ; ", " ", "   ", "\t", " \t "]),
    header=st.sampled_from([None, "{}X{}y{}Z", "{}x{}y{}z", '{}"x"{}"y"{}"z"']),
    newline=st.sampled_from(["\n", "\r\n", "\r"]),
    decimal=st.sampled_from(".,"),
    comment=st.booleans(),
)
def test_read_text_any_separator_header_and_decimal(folder, points, separator, header, newline, decimal, comment):
    if separator.strip(" ") == ",":
        decimal = "."
    lines = [separator.join(repr(float(v)) for v in row).replace(".", decimal) for row in points]
    if header:
        lines.insert(0, header.format("", separator, separator))
    if comment:
        lines.insert(0, "# made by a test, of x y z")
        lines.insert(3, "  # and another")
        lines.append("")
    cloud = read(folder, "a.csv", newline.join(lines) + newline)
    # pandas may round the last bit differently from repr
    same(cloud, points, rtol=1e-15)
    assert cloud.warnings == ()


@pytest.mark.parametrize("dtype", ["float16", "float32", "float64", "int8", "int64", "uint16", ">f4", ">f8", ">i4"])
def test_read_npy_number_types_and_records(folder, dtype):
    points = np.arange(12).reshape(4, 3).astype(dtype)
    same(read(folder, "a.npy", npy(points)), points)
    records = np.zeros(4, [("i", "u1"), ("Z", dtype), ("y", dtype), ("X", dtype)])
    records["X"], records["y"], records["Z"] = points.T
    same(read(folder, "a.npy", npy(records)), points, ("i", "Z", "y", "X"))


# ---- variants of the formats


@pytest.mark.parametrize(
    "name, text, expected",
    [
        *(("a.csv", f"x,y,z\n{q}1.5{q},{q}-2{q},{q}3{q}\n4,{q}5{q},6\n", [[1.5, -2, 3], [4, 5, 6]]) for q in "'\""),
        # separators and comments within quotes are ignored
        ("a.csv", 'x,y,z,l\n1,2,3,"a#b"\n4,5,6,c # "d\n', [[1, 2, 3], [4, 5, 6]]),
        *(
            (
                f"a.{suffix}",
                'name,x,y,z\n"person,sitting",1.5,2,3\n"car",4,5,6'.replace(",", mark),
                [[1.5, 2, 3], [4, 5, 6]],
            )
            for mark, suffix in ((",", "csv"), (";", "csv"), ("\t", "txt"), (" ", "xyz"))
        ),
        ("a.xyz", "1,5 2,5 3,5\n4 5 6,5\n", [[1.5, 2.5, 3.5], [4, 5, 6.5]]),
        # spellings of missing values
        *(
            ("a.csv", f"x,y,z\n1,2,3\n{missing},{missing},{missing}\n4,5,6\n", [[1, 2, 3], [4, 5, 6]])
            for missing in "nan NAN NaN Nan -NAN NULL Null n/a N/A none".split()
        ),
    ],
)
def test_read_text_quotes_decimals_and_missing_values(folder, name, text, expected):
    same(read(folder, name, text), expected)


def test_read_pcd_variants(folder):
    rows = POINTS.tobytes()
    same(read(folder, "A.PCD", pcd_header() + rows), fields=("x", "y", "z", "i"))
    same(read(folder, "a.pcd", pcd_header().replace(b"\n", b"\r\n") + rows))
    # an old version without COUNT and POINTS, an organized cloud, and rows after the last
    old = b"VERSION .5\nFIELDS x y z i\nSIZE 4 4 4 4\nTYPE F F F F\nWIDTH 3\nHEIGHT 1\nDATA binary\n"
    same(read(folder, "a.pcd", old + rows + b"more"))
    # padding fields named _ twice, and a field of several values
    padded = np.zeros(3, [("p", "u1", 4), ("x", "f4"), ("y", "f4"), ("q", "u1"), ("z", "f4"), ("h", "f4", 3)])
    padded["x"], padded["y"], padded["z"] = POINTS.T[:3]
    header = pcd_header("_ x y _ z h", "1 4 4 1 4 4", "U F F U F F", "4 1 1 1 1 3")
    same(read(folder, "a.pcd", header + padded.tobytes()))
    text = b"1 2 3 4 1.5 -2.25 0 0.125 9 9 9\n 1 2 3 4\t10 20  0 -1 nan 9 9 \n0 0 0 0 3 4 0 5 9 9 9"
    same(read(folder, "a.pcd", header.replace(b"DATA binary", b"DATA ascii") + text))
    one = pcd_header(points=1, data="ascii") + b"1.5 -2.25 0.125 0\n"
    same(read(folder, "a.pcd", one), POINTS[:1])
    # a field without values, lower-case types, blank lines, more rows than in the header, signed nan as in printf
    odd = pcd_header("e X Y Z", "4 4 4 4", "f f f u", "0 1 1 1", points=2, data="ascii")
    cloud = read(folder, "a.pcd", odd + b"\n-nan nan 3\n\n10  20\t5\n7 7 7\n")
    same(cloud, [[10, 20, 5]], ("e", "X", "Y", "Z"))
    assert cloud.num_dropped == 1


def test_read_ply_variants(folder):
    rows = POINTS.tobytes()
    before = "element camera 2\nproperty double a\nproperty uchar b\n"
    same(read(folder, "a.ply", ply_header(before=before) + bytes(18) + rows))
    text = "".join(f"{x} {y} {z} {i}\n" for x, y, z, i in POINTS.tolist())
    same(read(folder, "a.ply", ply_header(form="ascii", before=before).decode() + "1 2\n3 4\n" + text))
    # faces of several sizes after the points
    faces = "element face 2\nproperty list uchar int vertex_indices\n"
    body = struct.pack("<B3i", 3, 0, 1, 2) + struct.pack("<B4i", 4, 0, 1, 2, 0)
    same(read(folder, "a.ply", ply_header(after=faces) + rows + body))
    same(read(folder, "a.ply", ply_header(form="ascii", after=faces).decode() + text + "3 0 1 2\n4 0 1 2 0\n"))
    # names of normals and texture coordinates, and one name twice
    for names in ("x y z nx ny nz u v", "x y z a a a red green"):
        eight = np.hstack([POINTS, POINTS]).astype("f4").tobytes()
        same(read(folder, "a.ply", ply_header(names=names) + eight))
    cloud = read(folder, "a.ply", ply_header(2, "ascii", names="x y z") + b"\n-nan nan inf\r\n 3\t4  5 \n")
    same(cloud, POINTS[2:])
    assert cloud.num_dropped == 1
    twice = POINTS.astype("<f8").tobytes()
    same(read(folder, "a.ply", ply_header(kind="double", names="X Y Z i") + twice), fields=("X", "Y", "Z", "i"))


def test_read_bin_columns(folder):
    rng = np.random.default_rng(0)
    meters = rng.normal(scale=20, size=(8, 3)).astype(np.float32)
    ring = np.arange(8, dtype=np.float32)[:, None]
    nuscenes = np.hstack([meters, meters[:, :1], ring])
    fields = ("x", "y", "z", "intensity", "ring")
    # 7 rows of 5 do not divide by 4; 8 rows of 5 could be 10 rows of 4, only the ring column decides
    for rows in (7, 8):
        cloud = read(folder, "a.bin", nuscenes[:rows].tobytes())
        same(cloud, nuscenes[:rows], fields)
        assert len(cloud.warnings) == 1 and "columns 4" in cloud.warnings[0]
    # conversely, 10 rows of KITTI's 4 could be 8 rows of 5
    kitti = np.hstack([rng.normal(scale=20, size=(10, 3)), rng.uniform(0, 1, (10, 1))]).astype(np.float32)
    cloud = read(folder, "a.bin", kitti.tobytes())
    same(cloud, kitti)
    assert cloud.warnings == ()
    same(read(folder, "a.bin", kitti.tobytes(), columns=4), kitti, ("x", "y", "z", "intensity"))
    for name, options in (("sweep.pcd.bin", {}), ("a.bin", {"columns": 5})):
        cloud = read(folder, name, nuscenes.tobytes(), **options)
        same(cloud, nuscenes, fields)
        assert cloud.warnings == ()
    same(read(folder, "a.bin", meters.tobytes(), columns=3), meters, ("x", "y", "z"))
    same(read(folder, "a.bin", nuscenes[:, [0, 1, 2, 3, 4, 0]].tobytes(), columns=6), meters)


def _sweep(rng, n):
    distance, azimuth = rng.gamma(2, 8, n) + 2, rng.uniform(-np.pi, np.pi, n)
    return np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), rng.uniform(-2, 2, n)], 1)


def _person(rng, n):
    return rng.normal(0, [0.25, 0.25, 0.5], (n, 3)) + rng.uniform([3, -10, -1], [30, 10, 1])


@pytest.mark.parametrize("cloud", [_sweep, _person])
@pytest.mark.parametrize("n", [20, 21, 24, 30, 40, 45, 60, 75, 100, 240, 999, 1000, 2000])
def test_read_bin_infers_columns_from_values(folder, cloud, n):
    """Also for sizes divisible by 3, 4 and 5, and with a fifth column that is not a beam number."""
    rng = np.random.default_rng(n)
    xyz = cloud(rng, n)
    for intensity in (rng.uniform(0, 1, n), rng.beta(1, 5, n), rng.integers(0, 256, n), np.zeros(n)):
        rows = np.column_stack([xyz, intensity]).astype(np.float32)
        found = read(folder, "a.bin", rows.tobytes())
        same(found, rows)
        assert found.warnings == ()
        for fifth in (0.0, 0.05, rng.integers(0, 10, n) / 10):
            rows5 = np.column_stack([rows, np.broadcast_to(fifth, n)]).astype(np.float32)
            found = read(folder, "a.bin", rows5.tobytes())
            same(found, rows5, ("x", "y", "z", "intensity", "ring"))
            assert len(found.warnings) == 1 and "columns 4" in found.warnings[0]
    for count in range(n - 3, n + 1) if n >= 40 else ():
        triples = read(folder, "a.bin", xyz[:count].astype(np.float32).tobytes())
        same(triples, xyz[:count].astype(np.float32), ("x", "y", "z"))
        mixed = [f"rows of {columns} would mix" for columns in (4, 5) if count % columns == 0]
        reason = mixed[0] if mixed else "the size is a multiple of 3 values and not of 4"
        assert f"rows of 3 float32, since {reason}" in triples.warnings[0]
    # rows that are cut off are not taken for rows of 3
    cut_off = np.column_stack([xyz, rng.uniform(0, 1, n)]).astype(np.float32).ravel()
    cut_off = cut_off[: next(size for size in range(4 * n - 1, 0, -1) if size % 3 == 0 and size % 4 and size % 5)]
    with pytest.raises(InputError, match="not a multiple of 16"):
        read(folder, "a.bin", cut_off.tobytes())


@pytest.mark.parametrize("cloud", [_sweep, _person])
@pytest.mark.parametrize("n", [22, 40, 60, 100, 999, 2000])
def test_read_bin_infers_six_columns_from_values(folder, cloud, n):
    """Rows of x y z intensity beam time; their size is divisible by 3 and may be by 4 and 5."""
    rng = np.random.default_rng(n)
    rows = np.column_stack([cloud(rng, n), rng.uniform(0, 1, n), rng.integers(0, 64, n), np.linspace(0, 0.1, n)])
    found = read(folder, "a.bin", rows.astype(np.float32).tobytes())
    same(found, rows.astype(np.float32))
    assert len(found.warnings) == 1 and "read as rows of 6 float32" in found.warnings[0]


@pytest.mark.parametrize(
    "header", ["Points_m_XYZ:0,Points_m_XYZ:1,Points_m_XYZ:2", '"Points:0","Points:1","Points:2"', "x [m],Y(m),z [m]"]
)
def test_read_text_accepts_axis_names_of_other_programs(folder, header):
    same(read(folder, "a.csv", f"{header},intensity\n1.5,-2.25,0.125,7\n10,20,-1,8\n3,4,5,9\n"), fields=None)


@pytest.mark.parametrize("mark", [" ", ","])
def test_read_text_skips_point_count_line(folder, mark):
    rows = "\n".join(mark.join(row) for row in (["1.5", "-2.25", "0.125"], ["10", "20", "-1"], ["3", "4", "5"]))
    same(read(folder, "a.xyz", f"3\n{rows}\n"), fields=None)


@pytest.mark.parametrize("header", ["//X Y Z\n3\n", "3\n//X Y Z\n", '"x" "y" "z"\n3\n'])
def test_read_text_skips_point_count_line_of_cloudcompare(folder, header):
    same(read(folder, "a.asc", f"{header}1.5 -2.25 0.125\n10 20 -1\n3 4 5\n"))
    # a later row with a single number is an incomplete point
    assert read(folder, "a.txt", "x y z\n1.5 -2.25 0.125\n3\n3 4 5\n").num_dropped == 1


def test_read_text_knows_columns_of_ouster_sdk(folder):
    header = "# frame num: 0\n# TIMESTAMP (ns), ROW, RANGE (mm), X1 (m), Y1 (m), Z1 (m)\n"
    rows = "100, 0, 9, 1.5, -2.25, 0.125\n200, 1, 9, 10, 20, -1\n300, 2, 9, 3, 4, 5\n"
    same(read(folder, "a.csv", header + rows))
    for names in (header.replace("(m)", "(mm)"), "# row, lon, lat, height, a, b\n"):
        refusal(read, folder, "a.csv", names + rows, words=["columns x, y and z"])


@pytest.mark.parametrize("word", ["-nan(ind)", "nan(snan)", "1.#QNAN", "-1.#IND", "1.#INF00"])
def test_read_points_knows_nan_of_microsofts_libraries(folder, word):
    for name, header in (
        ("a.csv", "x,y,z\n"),
        ("a.pcd", pcd_header(data="ascii")),
        ("a.ply", ply_header(form="ascii")),
    ):
        row, mark = (f"{word} 2 3", ",") if name == "a.csv" else (f"{word} 2 3 0", " ")
        rest = "\n".join(" ".join(map(str, point[: 3 if mark == "," else 4])) for point in POINTS[1:].tolist())
        text = f"{row}\n{rest}\n".replace(" ", mark)
        cloud = read(folder, name, (header.encode() if isinstance(header, str) else header) + text.encode())
        same(cloud, POINTS[1:])
        assert cloud.num_dropped == 1


def test_read_pcd_without_sizes_and_types(folder):
    header = "# .PCD v.5 - Point Cloud Data file format\nFIELDS x y z i\nPOINTS 3\nDATA binary\n"
    same(read(folder, "a.pcd", header.encode() + POINTS.tobytes()))


def test_read_bin_assumes_four_columns_if_ambiguous(folder):
    """If all columns are alike, it takes KITTI's four and warns if another number fits better by chance."""
    warned = 0
    for seed in range(30):
        rows = np.random.default_rng(seed).normal(size=(60, 4)).astype(np.float32)
        found = read(folder, "a.bin", rows.tobytes())
        same(found, rows)
        warned += len(found.warnings)
        doubt = "rows of 4 float32 (KITTI), since nothing clearly indicates rows of"
        assert all(doubt in line for line in found.warnings)
    assert 0 < warned < 30


def test_read_bin_accepts_printable_bytes(folder):
    points = np.full((2, 4), 837282, np.float32)
    assert points.tobytes().isascii() and points.tobytes().decode().isprintable()
    same(read(folder, "a.bin", points.tobytes()), points)


def test_read_npz_chooses_array(folder):
    other = POINTS + 1
    same(read(folder, "a.npz", npz(xyz=other, points=POINTS)))
    same(read(folder, "a.npz", npz(other=other, xyz=POINTS)))
    same(read(folder, "a.npz", npz(cloud=POINTS, labels=np.zeros(3), name=np.array("me"))))
    file = io.BytesIO()
    np.savez_compressed(file, points=POINTS)
    same(read(folder, "a.npz", file.getvalue()))


def test_read_text_variants(folder):
    same(read(folder, "a.xyz", "\ufeff1.5 -2.25 .125 7\n1e1 +20 -1 8\n\n3 4 5 9 # the last\n"))
    same(read(folder, "a.txt", "//X,Y,Z,Intensity\n1.5,-2.25,0.125,7\n10,20,-1,8\n3,4,5,9"))
    same(read(folder, "a.csv", "time,z,label,y,x\n0,0.125,a b,-2.25,1.5\n0,-1,c,20,10\n0,5,,4,3\n"))
    # a header in a comment gives the order, as written by numpy.savetxt
    cloud = read(folder, "a.txt", "# i z y x\n7 0.125 -2.25 1.5\n8 -1 20 10\n9 5 4 3\n")
    same(cloud, fields=("i", "z", "y", "x"))
    # a column of row numbers without a name, as written by pandas
    same(read(folder, "a.csv", ",x,y,z\n0,1.5,-2.25,0.125\n1,10,20,-1\n2,3,4,5\n"), fields=("", "x", "y", "z"))
    cloud = read(folder, "a.txt", "# a comment\n1.5 -2.25 0.125 7 0\n10 20 -1 8 0\n3 4 5 9 0\n")
    same(cloud, fields=("x", "y", "z", "column_4", "column_5"))
    same(read(folder, "a.csv", "x\ty\tz\tname of it\n1.5\t-2.25\t0.125\tme too\n10\t20\t-1\t\n3\t4\t5\tb\n"))


def test_read_text_detects_decimal_commas_in_later_lines(folder):
    expected = [[1e-05, 1, 2], [0.5, 1, 2.25]]
    for content in ("1e-05;1;2\n0,5;1;2,25\n", "x;y;z\n1e-05;1;2\n0,5;1;2,25\n", "1e-05 1 2\n0,5 1 2,25\n"):
        same(read(folder, "a.csv", content), expected)
    # a comma within words is not a decimal comma
    same(read(folder, "a.csv", "x\ty\tz\tname\n1e-05\t1\t2\tno 1,5\n0.5\t1\t2.25\tb\n"), expected)
    same(read(folder, "a.csv", "x;y;z;name\n1e-05;1;2;a,1\n0.5;1;2.25;b\n"), expected)


def test_read_points_keeps_precision_of_map_coordinates(folder):
    """Float64 is kept, and text keeps all digits, whatever the type in its header."""
    points = np.array([[500000.001, 5000000.002, 100.003], [500001.0, 5000001.0, 99.999]])
    text = "\n".join(" ".join(map(str, row)) for row in points.tolist()).encode()
    wide, narrow = (
        pcd_header("x y z", f"{n} {n} {n}", "F F F", "1 1 1", 2, kind) for n, kind in ((8, "binary"), (4, "ascii"))
    )
    same(read(folder, "utm.xyz", text), points, rtol=1e-15)
    same(read(folder, "utm.pcd", wide + points.tobytes()), points)
    same(read(folder, "utm.pcd", narrow + text), points)
    same(read(folder, "utm.ply", ply_header(2, kind="double", names="x y z") + points.tobytes()), points)
    same(read(folder, "utm.ply", ply_header(2, "ascii", names="x y z") + text), points)


def test_read_points_drops_and_counts_nonfinite_rows(folder):
    points = POINTS.copy()
    points[0, 1], points[1, 3] = np.nan, np.inf  # the second row has finite coordinates
    contents = {
        "a.pcd": pcd_header() + points.tobytes(),
        "a.ply": ply_header() + points.tobytes(),
        "a.bin": points.tobytes(),
        "a.npy": npy(points),
        "a.csv": "x,y,z\n1,,2\n10,20,-1\n3,4,5\n",
        "a.xyz": "1 nan 2\n10 20 -1\n3 4 5\n",
    }
    for name, content in contents.items():
        cloud = read(folder, name, content)
        same(cloud, POINTS[1:])
        assert cloud.num_dropped == 1 and len(cloud.warnings) == 1 and "1 of 3" in cloud.warnings[0]
    for value in ("inf", "-inf", "NA", "null", "-nan", "1e999"):
        assert read(folder, "a.csv", f"1,2,3\n1,{value},2\n").num_dropped == 1, value


# ---- bad inputs: (name of the file, content, words that the message must have)

ROWS = POINTS.tobytes()
HUGE = 10**12
PNG = b"\x89PNG\r\n\x1a\n" + bytes(40)
TEXT = "1 2 3\n4 5 6\n"
COMPRESSED = pcd_header(data="binary_compressed")
OBJECTS = npy(np.array([[1, 2, "a"]], dtype=object), allow_pickle=True)


def with_bytes(content, place, new):
    return content[:place] + new + content[place + len(new) :]


BAD = {
    "empty": ("a.pcd", b"", ["empty"]),
    "unknown suffix": ("a.las2", ROWS, ["'.las2'", *SUFFIXES]),
    "livox recording": ("a.lvx3", ROWS, ["'.lvx3'", "Livox Viewer"]),
    "boxes": ("a.json", ROWS, ["'.json'", "--boxes"]),
    "ouster recording": ("a.osf", ROWS, ["'.osf'", "ouster-cli source FILE.osf save FILE.pcap"]),
    "e57": ("a.e57", ROWS, ["'.e57'", ".las or .ply"]),
    "no suffix": ("cloud", ROWS, ["suffix ''", ".pcd"]),
    "las as ply": ("a.ply", las(), ["rename it to .las"]),
    "las cut off": ("a.las", las()[:-1], ["cut off", "expected 60", "got 59"]),
    "las header alone": ("a.las", las()[:99], ["LAS header", "99"]),
    "las of 10^9": ("a.las", with_bytes(las(), 107, struct.pack("<I", 10**9)), ["cut off", "1000000000"]),
    "laz of 10^9": ("a.laz", with_bytes(las(packed=True), 107, struct.pack("<I", 10**9)), ["LIDARPOSE_MAX_UNPACKED"]),
    "laz cut off": ("a.laz", las(np.tile(POINTS, (99, 1)), packed=True)[:-200], ["damaged or cut off"]),
    "las format 20": ("a.las", with_bytes(las(), 104, b"\x14"), ["point format 0 to 10", "20"]),
    "las without points": ("a.las", las(np.zeros((0, 3))), ["has no points"]),
    "las scale": ("a.las", with_bytes(las(), 131, struct.pack("<d", np.nan)), ["finite scales", "nan"]),
    "gzip as pcd": ("a.pcd", gzip.compress(pcd_header() + ROWS), ["gzip-compressed", "unpack it first"]),
    "gzip by suffix": ("a.pcd.gz", gzip.compress(pcd_header() + ROWS), ["gzip-compressed", "unpack it first"]),
    "zip as ply": ("a.ply", zipped("a.ply", b"ply\n"), ["zip", "unpack it first"]),
    "png as pcd": ("a.pcd", PNG, ["PNG"]),
    "web page": ("a.ply", b"<!DOCTYPE html><html>", ["web page"]),
    "git lfs": ("a.pcd", b"version https://git-lfs.github.com/spec/v1\n", ["git lfs pull"]),
    "ply as pcd": ("a.pcd", ply_header() + ROWS, [".ply"]),
    "npy as bin": ("a.bin", npy(POINTS), [".npy"]),
    "npy as npz": ("a.npz", npy(POINTS), [".npy"]),
    "npz as npy": ("a.npy", npz(points=POINTS), ["rename it to .npz"]),
    "zip as npz": ("a.npz", zipped("a.txt", TEXT), ["zip archive"]),
    "text as bin": ("a.bin", TEXT * 4, ["text", ".txt"]),
    "text as pcd": ("a.pcd", TEXT, ["PCD header"]),
    "text as npy": ("a.npy", TEXT, [".npy header"]),
    "text as ply": ("a.ply", TEXT, ["PLY header"]),
    "text as npz": ("a.npz", TEXT, [".npz"]),
    "pcd without data": ("a.pcd", pcd_header()[:60], ["DATA"]),
    "pcd without fields": ("a.pcd", b"VERSION .7\nPOINTS 3\nDATA ascii\n1 2 3\n", ["x, y and z"]),
    "pcd without xyz": ("a.pcd", pcd_header("a b c d") + ROWS, ["x, y and z", "a b c d"]),
    "pcd cut off": ("a.pcd", pcd_header() + ROWS[:-1], ["cut off", "48", "47"]),
    "pcd of 10^12": ("a.pcd", pcd_header(points=HUGE) + ROWS, ["cut off", "1000000000000"]),
    "pcd ascii of 10^12": ("a.pcd", pcd_header(points=HUGE, data="ascii") + b"1 2 3 4\n", ["cut off"]),
    "pcd ascii cut off": ("a.pcd", pcd_header(data="ascii") + b"1.5 2.5 3.5 4\n1 2 3 4\n", ["cut off", "got 2"]),
    "pcd ascii words": ("a.pcd", pcd_header(data="ascii") + b"1 2 3 4\n1 b 3 4\n1 2 3 4\n", ["'1 b 3 4'", "line 2"]),
    "pcd ascii stops": (
        "a.pcd",
        pcd_header(data="ascii") + b"1 2 3 4\n" * 2 + b"1 2 3,5 4\n",
        ["'1 2 3,5 4'", "line 3"],
    ),
    "pcd ascii short": ("a.pcd", pcd_header(data="ascii") + b"1 2\n" * 9, ["'1 2'", "line 1"]),
    "pcd ascii comment": ("a.pcd", pcd_header(data="ascii") + b"1 2 3 4\n# 2 3 4\n1 2 3 4\n", ["'# 2 3 4'", "line 2"]),
    "pcd ascii count": ("a.pcd", pcd_header(count=f"1 1 1 {HUGE}", data="ascii") + b"1 2 3 4\n" * 3, [str(HUGE + 3)]),
    "pcd ascii of bytes": ("a.pcd", pcd_header(data="ascii") + b"\xff\xfe\xfd" * 9, ["UTF-"]),
    "pcd compressed 10^12": ("a.pcd", pcd_header(points=HUGE, data="binary_compressed") + bytes(40), ["10"]),
    "pcd compressed cut off": ("a.pcd", COMPRESSED + struct.pack("<II", 40, 48) + bytes(9), ["cut off"]),
    "pcd compressed no sizes": ("a.pcd", COMPRESSED + b"\x01", ["cut off"]),
    "pcd compressed damaged": ("a.pcd", COMPRESSED + struct.pack("<II", 9, 48) + b"\xff" * 9, ["a.pcd"]),
    "pcd compressed zeros": (
        "a.pcd",
        pcd_header(points=2**24, data="binary_compressed") + struct.pack("<II", 2**22, 2**28) + bytes(2**22),
        ["67108864 bytes or 32 times", "268435456 from 4194304", "LIDARPOSE_MAX_UNPACKED=268435456"],
    ),
    "pcd compressed bomb": ("a.pcd", COMPRESSED + struct.pack("<II", 1, 2**32 - 1) + b"\x00", ["4294967295"]),
    "pcd negative count": ("a.pcd", pcd_header(points=-3) + ROWS, ["POINTS", "'-3'"]),
    "pcd float16": ("a.pcd", pcd_header(size="2 2 2 2") + ROWS, ["TYPE", "'f2'"]),
    "pcd sizes missing": ("a.pcd", pcd_header(size="4 4") + ROWS, ["2 sizes"]),
    "pcd x of two": ("a.pcd", pcd_header(count="2 1 1 1") + ROWS * 2, ["COUNT 1"]),
    "pcd encoding": ("a.pcd", pcd_header(data="zstd") + ROWS, ["'zstd'", "binary_compressed"]),
    "pcd no points": ("a.pcd", pcd_header(points=0), ["has no points"]),
    "pcd all nan": ("a.pcd", pcd_header() + np.full((3, 4), np.nan, "f4").tobytes(), ["NaN", "all 3"]),
    "ply cut off": ("a.ply", ply_header() + ROWS[:-1], ["cut off"]),
    "ply of 10^12": ("a.ply", ply_header(HUGE) + ROWS, ["cut off", "1000000000000"]),
    "ply ascii cut off": ("a.ply", ply_header(3, "ascii") + b"1 2 3 4\n1 2 3 4\n", ["cut off"]),
    "ply lines before of 10^17": (
        "a.ply",
        ply_header(form="ascii", before=f"element u {10**17}\nproperty int a\n") + b"1\n",
        ["cut off"],
    ),
    "ply without end": ("a.ply", ply_header()[:50], ["end_header"]),
    "ply without vertex": ("a.ply", b"ply\nformat ascii 1.0\nelement face 1\nend_header\n1\n", ["'vertex'"]),
    "ply without format": ("a.ply", b"ply\nelement vertex 1\nproperty float x\nend_header\n1\n", ["format"]),
    "ply odd line": ("a.ply", b"ply\nformat ascii 1.0\nwhat is this\nend_header\n", ["'what is this'"]),
    "ply list": ("a.ply", ply_header(kind="list uchar int") + ROWS, ["list uchar int"]),
    "ply list before": ("a.ply", ply_header(before="element f 1\nproperty list uchar int a\n") + ROWS, ["list"]),
    "ply no points": ("a.ply", ply_header(0), ["has no points"]),
    "ply odd count": ("a.ply", ply_header("many") + ROWS, ["'many'"]),
    "bin odd size": ("a.bin", ROWS[:-1], ["47 bytes", "cut off"]),
    "bin of three": ("a.bin", np.ones((7, 3), "f4").tobytes(), ["84 bytes", "columns 3"]),
    "bin of three or six": ("a.bin", np.ones((102, 3), "f4").tobytes(), ["values per row (--columns 3 or 6)"]),
    "bin garbage": ("a.bin", np.random.default_rng(0).bytes(4000), ["beyond"]),
    "npy objects": ("a.npy", OBJECTS, ["dtype object"]),
    "npz objects": ("a.npz", npz(points=np.array([[1, 2, "a"]], dtype=object)), ["dtype object"]),
    "npy cut off": ("a.npy", npy(POINTS)[:-1], ["cut off"]),
    "npy header cut off": ("a.npy", npy(POINTS)[:20], ["header"]),
    "npy of 10^12": ("a.npy", npy_header((HUGE, 3)), ["cut off"]),
    "npy of 10^40": ("a.npy", npy_header((10**40, 3)), ["cut off"]),
    "npy of huge empty rows": ("a.npy", npy_header((2**70, 0)), ["the shape (1180591620717411303424, 0)"]),
    "npy of many dimensions": ("a.npy", npy_header((1,) * 99) + ROWS, ["the shape (1, 1, "]),
    "npy of a logical shape": ("a.npy", npy_header((True, 3)) + ROWS, ["the shape (True, 3)"]),
    "npy negative": ("a.npy", npy_header((-1, 3)) + ROWS, ["(-1, 3)"]),
    "npy flat": ("a.npy", npy(POINTS.ravel()), ["(12,)", "(n, 3+)"]),
    "npy two columns": ("a.npy", npy(np.ones((9, 2))), ["(9, 2)", "save x, y and z"]),
    "npy transposed": ("a.npy", npy(np.ones((2, 3)).T[:, :2]), ["points.T"]),
    "npy depth image": ("a.npy", npy(np.ones((48, 64))), ["(48, 64)", "depth image"]),
    "npy transposed records": ("a.npy", npy(np.ones((5, 51))), ["(5, 51)", "points.T"]),
    "npy batch": ("a.npy", npy(np.ones((2, 5, 4))), ["(2, 5, 4)", "reshape(-1, 4)"]),
    "npy words": ("a.npy", npy(np.array([["a", "b", "c"]])), ["<U1"]),
    "npy complex": ("a.npy", npy(np.ones((2, 3), complex)), ["complex128"]),
    "npz cut off": ("a.npz", npz(points=POINTS)[:-30], [".npz", "cut off"]),
    "npz damaged": ("a.npz", npz(points=POINTS).replace(ROWS[:8], ROWS[8:16]), [".npz", "damaged"]),
    "npy of python": ("a.npy", npy(POINTS).replace(b"}", b"("), ["damaged"]),
    "npz of two": ("a.npz", npz(a=POINTS, b=POINTS), ["'points'", "a, b"]),
    "npz of none": ("a.npz", npz(a=np.ones(3)), ["'points'", "got a"]),
    "npz of 10^12": ("a.npz", zipped("points.npy", npy_header((HUGE, 3))), ["cut off"]),
    "txt of words": ("a.txt", "hello world this is\nsome text\n", ["'hello world this is'", "line 1"]),
    "txt transposed": ("a.txt", "\n".join(["1.5 " * 60] * 3), ["got 3 lines of 60", "transpose"]),
    "txt of two columns": ("a.txt", "1 2\n3 4\n", ["got 2 on line 1"]),
    "txt of comments": ("a.txt", "# nothing\n\n# here\n", ["has no points"]),
    "csv header alone": ("a.csv", "x,y,z\n", ["has no points"]),
    "csv other header": ("a.csv", "# by me\nlon,lat,height\n1,2,3\n", ["'lon,lat,height'", "line 2"]),
    "csv word below": ("a.csv", "# by me\nx,y,z\n1,2,3\n# odd\n1,oops,3\n", ["'1,oops,3'", "line 5"]),
    "csv of feet": ("a.csv", "x,y,z\n5'30,2,3\n", ["5'30"]),
    "csv of short rows": ("a.csv", "x,y,z\n1,2\n3,4\n", ["'1,2'", "line 2"]),
    "csv open quote": ("a.csv", 'x,y,z\n1,2,"3\n', ["rows of numbers"]),
    "csv quote over lines": ("a.csv", 'x,y,z,l\n1,2,3,"a\n1,2,3,b\n1,2,3,"c\n', ["a point per line", "several lines"]),
    "csv all missing": ("a.csv", "x,y,z\n,,\nNA,1,2\n", ["NaN", "all 2"]),
    "txt utf-16": ("a.txt", TEXT.encode("utf-16"), ["UTF-16", "UTF-8"]),
    "txt latin-1": ("a.txt", b"# \xe4\n1 2 3\n", ["UTF-8"]),
    "txt zeros": ("a.txt", b"1 2 3\n\x00\x00\n", ["zero bytes"]),
    "xyz of bytes": ("a.xyz", bytes(range(128, 256)), ["UTF-8"]),
    "odd name": ("a\nb.pcd", b"", ["empty"]),
}


def test_read_npz_limits_unpacked_size(folder, monkeypatch):
    zeros, file = np.zeros((2**20, 3), np.float32), io.BytesIO()
    np.savez_compressed(file, points=zeros)
    same(read(folder, "zeros.npz", file.getvalue()), zeros)
    check_unpacked(2**30, 10**8 * 3 * 8)
    monkeypatch.setenv("LIDARPOSE_MAX_UNPACKED", "1000000")
    with pytest.raises(
        InputError, match="a.npz: expected at most 1000000 bytes or 32 .*LIDARPOSE_MAX_UNPACKED=12583040"
    ):
        read(folder, "a.npz", file.getvalue())
    monkeypatch.setenv("LIDARPOSE_MAX_UNPACKED", "12583040")
    same(read(folder, "a.npz", file.getvalue()), zeros)
    monkeypatch.setenv("LIDARPOSE_MAX_UNPACKED", "1 GB")
    with pytest.raises(InputError, match="expected a number of bytes in LIDARPOSE_MAX_UNPACKED, got '1 GB'"):
        read(folder, "a.npz", file.getvalue())


@pytest.mark.parametrize("case", BAD)
def test_read_points_reports_bad_content_in_one_line(tmp_path, case):
    name, content, words = BAD[case]
    message = refusal(read, tmp_path, name, content, words=words)
    assert message.startswith(f"{tmp_path / name}: ") or not name.isprintable()


def test_read_points_rejects_bad_paths(tmp_path):
    (tmp_path / "sweep_1.pcd").write_bytes(b"x")
    (tmp_path / "folder.pcd").mkdir()
    cases = {
        tmp_path / "sweep_2.pcd": ["no such file", "did you mean sweep_1.pcd"],
        tmp_path / "gone" / "a.pcd": ["no such file", f"the folder {tmp_path / 'gone'} does not exist"],
        tmp_path / "folder.pcd": ["folder"],
        "": ["'': no such file", "give its name"],
        tmp_path / "sweep_1.pcd" / "a.pcd": ["cannot be read"],
        tmp_path / ("a" * 300 + ".pcd"): ["cannot be read"],
        "a\0.pcd": ["expected the path"],
        3.5: ["expected the path"],
        None: ["expected the path"],
    }
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe.pcd")
        cases[tmp_path / "pipe.pcd"] = ["pipe"]
    for path, words in cases.items():
        refusal(read_points, path, words=words)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may read everything")
def test_read_points_reports_unreadable_file(tmp_path):
    path = tmp_path / "a.pcd"
    path.write_bytes(b"x")
    path.chmod(0)
    with pytest.raises(InputError, match="cannot be read.*permissions"):
        read_points(path)


@pytest.mark.parametrize("columns", [0, 2, -4, True, 4.0, "4"])
def test_read_bin_rejects_bad_columns(tmp_path, columns):
    with pytest.raises(InputError, match="columns must be a whole number of at least 3"):
        read(tmp_path, "a.bin", ROWS, columns=columns)


def test_import_point_cloud_loads_no_heavy_library():
    heavy = {"pandas", "lzf", "torch"}
    code = f"import sys, lidarpose.io.point_cloud; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "text", ['"x" "y" "z"\n"1" 0.1 0.2 0.3\n"2" 1.1 1.2 1.3\n', "x,y,z\n0,0.1,0.2,0.3\n", "# rows\nx y z\n\n1 2 3 4\n"]
)
def test_read_text_rejects_rows_longer_than_header(tmp_path, text):
    """Row numbers, as written by R or pandas, would shift all columns by one."""
    path = tmp_path / "r.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=r"expected 3 values per row, as its header says, got 4 on line \d"):
        read_points(path)
    path.write_text("x,y,z\n0.1,0.2,0.3,\n")
    np.testing.assert_allclose(read_points(path).points, [[0.1, 0.2, 0.3]])


@pytest.mark.parametrize("text", ["1 2 3{}# note\n", "1e-05{}2 3\n0,5 1 2\n", "1\t2{}\t3 # a\n4\t{}5,5\t6\n"])
def test_read_text_with_long_runs_of_blanks(tmp_path, text):
    """With backtracking over the blanks this would take an hour."""
    path = tmp_path / "b.txt"
    path.write_text(text.format(" " * 200_000, " " * 200_000))
    assert len(read_points(path).points) == text.count("\n")


@pytest.mark.parametrize("options", [{}, {"index": False}, {"sep": ";"}, {"sep": ";", "decimal": ",", "index": False}])
def test_header_of_column_numbers_is_no_point(options):
    points = np.random.default_rng(0).normal(size=(20, 4))
    read, _ = parse_text(pd.DataFrame(points).to_csv(**options).encode())
    np.testing.assert_allclose(read, points[:, :3])
    # a point that looks like such a header
    np.testing.assert_array_equal(parse_text(b"0,1,2\n3,4,5\n")[0], [[0, 1, 2], [3, 4, 5]])


@pytest.mark.parametrize("first, count, counts", [(0, 20, True), (1, 300, True), (2, 300, False), (0, 19, False)])
def test_first_column_that_counts_rows_is_not_x(first, count, counts):
    rows = np.c_[first + np.arange(count), np.random.default_rng(0).normal(size=(count, 3)).round(3)]
    text = "\n".join(" ".join(map(str, row)) for row in rows.tolist()).encode()
    points, names = parse_text(text)
    assert names == (("row", "x", "y", "z") if counts else ("x", "y", "z", "column_4"))
    np.testing.assert_array_equal(points, rows[:, 1:] if counts else rows[:, :3])
    # a header says what the column is
    assert parse_text(b"x y z i\n" + text)[1] == ("x", "y", "z", "i")


@pytest.mark.parametrize("viewpoint, warns", [("1 -2.5 3 1 0 0 0", True), ("0 0 0 1 0 0 0", False), ("a b c", False)])
def test_pcd_viewpoint_is_named_and_not_used(folder, viewpoint, warns):
    header = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\n"
    path = folder / "viewpoint.pcd"
    path.write_text(f"{header}VIEWPOINT {viewpoint}\nPOINTS 1\nDATA ascii\n4 5 6\n")
    cloud = read_points(path)
    assert cloud.points.tolist() == [[4, 5, 6]] and len(cloud.warnings) == warns
    assert not warns or cloud.warnings[0].endswith("--sensor-origin 1,-2.5,3")
