"""Small valid files of all kinds that the readers accept, functions that damage them, and a check of error messages.

The writers are literal, so that they share no code with the readers.
"""

import io
import json
import pickle
import struct
import zipfile

import laspy
import lazrs
import numpy as np
import pytest
from hypothesis import strategies as st

from lidarpose.errors import InputError

POINTS = np.array([[1.5, -2.25, 0.125, 7], [10, 20, -1, 8], [3, 4, 5, 9]], np.float32)
KITTI = b"Pedestrian 0 0 -0.2 712 143 810 307 1.89 0.48 1.2 1.84 1.47 8.41 0.01\n"


def refusal(call, *args, words=(), **options) -> str:
    """Assert that a call raises an InputError of one printable line that contains `words`; return the line."""
    with pytest.raises(InputError) as caught:
        call(*args, **options)
    error, message = caught.value, str(caught.value)
    assert message.isprintable() and len(message) < 600
    assert "Traceback" not in message and "Error:" not in message, message
    assert error.__cause__ is None and (error.__context__ is None or error.__suppress_context__)
    assert all(word in message for word in words), message
    return message


# ---- points


def with_changed_bytes(data: bytes, random: np.random.Generator, most: int, count: int = 60):
    """Copies of a file with 1 to `most` - 1 bytes replaced by random ones."""
    for _ in range(count):
        broken = np.frombuffer(data, np.uint8).copy()
        at = random.integers(0, len(data), random.integers(1, most))
        broken[at] = random.integers(0, 256, len(at))
        yield broken.tobytes()


def pcd_header(fields="x y z i", size="4 4 4 4", kind="F F F F", count="1 1 1 1", points=3, data="binary"):
    return (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {size}\nTYPE {kind}\nCOUNT {count}\nWIDTH {points}\n"
        f"HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {data}\n"
    ).encode()


def ply_header(points=3, form="binary_little_endian", kind="float", names="x y z i", before="", after="", newline="\n"):
    lines = [
        "ply",
        f"format {form} 1.0",
        "comment made by a test",
        *before.split("\n")[:-1],
        f"element vertex {points}",
    ]
    lines += [f"property {kind} {name}" for name in names.split()] + after.split("\n")[:-1] + ["end_header", ""]
    return newline.join(lines).encode()


def lzf_body(content):
    """LZF data without back references, in runs of at most 32 literal bytes."""
    runs = [content[i : i + 32] for i in range(0, len(content), 32)]
    packed = b"".join(bytes([len(run) - 1]) + run for run in runs)
    return struct.pack("<II", len(packed), len(content)) + packed


def npy(array, **options):
    file = io.BytesIO()
    np.save(file, array, **options)
    return file.getvalue()


def npz(**arrays):
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def npy_header(shape, descr="<f4"):
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"shape": shape, "fortran_order": False, "descr": descr})
    return file.getvalue()


def zipped(name, content):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(name, content)
    return file.getvalue()


_TEXT = "".join(f"{x} {y} {z} {i}\n" for x, y, z, i in POINTS.tolist())


def las(points=POINTS, *, version="1.2", kind=0, packed=False, step=1e-3, shift=(0.0, 0.0, 0.0), times=None) -> bytes:
    """A LAS or LAZ file written by laspy."""
    header = laspy.LasHeader(point_format=kind, version=version)
    header.scales, header.offsets = np.full(3, step), np.array(shift)
    cloud = laspy.LasData(header)
    cloud.xyz = np.asarray(points, float)[:, :3]
    if times is not None:
        cloud.gps_time = times
    file = io.BytesIO()
    cloud.write(file, do_compress=packed, laz_backend=laspy.LazBackend.Lazrs if packed else None)
    return file.getvalue()


def laz_of_chunks(points=POINTS, sizes=(1, 2)) -> bytes:
    """A LAZ file whose chunks have different numbers of points, as in COPC."""
    plain, packed = las(points), las(points, packed=True)
    start, plain_start = (struct.unpack_from("<I", data, 96)[0] for data in (packed, plain))
    old, new = (lazrs.LazVlr.new_for_compression(0, 0, variable).record_data() for variable in (False, True))
    file = io.BytesIO(packed[:start].replace(old, new))
    file.seek(0, 2)
    compressor = lazrs.LasZipCompressor(file, lazrs.LazVlr(new))
    records = plain[plain_start:]
    for size in sizes:
        compressor.compress_many(records[: 20 * size])
        compressor.finish_current_chunk()
        records = records[20 * size :]
    compressor.done()
    return file.getvalue()


POINT_FILES = {
    "a.las": las(),
    "b.las": las(version="1.4", kind=6),
    "a.laz": las(np.tile(POINTS, (99, 1)), kind=1, packed=True),
    "b.laz": laz_of_chunks(),
    "a.pcd": pcd_header() + POINTS.tobytes(),
    "b.pcd": pcd_header(data="ascii") + _TEXT.encode(),
    "c.pcd": pcd_header(data="binary_compressed") + lzf_body(POINTS.T.tobytes()),
    "a.ply": ply_header() + POINTS.tobytes(),
    "b.ply": ply_header(form="ascii") + _TEXT.encode(),
    "a.npy": npy(POINTS),
    "a.npz": npz(points=POINTS),
    "a.bin": POINTS.tobytes(),
    "a.csv": b"x,y,z,i\n" + _TEXT.replace(" ", ",").encode(),
    "a.xyz": _TEXT.encode(),
}


# ---- boxes

_PERSON = {"center": [10.0, -2.0, 0.5], "size": [0.6, 0.7, 1.8], "yaw": 0.3, "id": "a"}
BOX_FILES = {
    "boxes.json": json.dumps({"people": [_PERSON, {**_PERSON, "id": None, "track": 7}]}).encode(),
    "rows.json": b"[[1, 2, 3, 0.5, 0.6, 1.7, -1]]",
    "rows.npy": npy(np.array([[1, 2, 3, 0.5, 0.6, 1.7, -1]])),
    "label.txt": KITTI,
}
CALIBRATION = b"R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"


# ---- pickles

ARRAYS = [
    np.arange(12.0).reshape(3, 4),
    np.asfortranarray(np.arange(12, dtype=">f4").reshape(3, 4)),
    np.zeros((0, 3), np.int16),
    np.array(2.5),
    np.array([True, False]),
    np.array(["left", "hip"]),
    np.array([b"ab", b"c"]),
    np.array([1 + 2j, 3]),
    np.arange(24, dtype=np.uint8).reshape(2, 3, 4)[:, ::2],
]
DATA = {
    "arrays": ARRAYS,
    "scalars": (np.float32(3), np.int64(-2), np.bool_(True)),
    "plain": [None, True, 1, -1, 2**70, -(2**70), 1.5, "größe", b"\x00\xff", 1 + 2j, ""],
    "nested": {"a": [{"b": (1, [2, ()])}], (1, "x"): {1, 2}, 3: frozenset({"y"})},
    "objects": np.array([np.zeros(2), "x", None, [1]], dtype=object),
}


def old_array(values: np.ndarray, code: bytes, module: bytes = b"numpy.core.multiarray") -> bytes:
    """A pickled array as Python 2 and an old numpy wrote it: its bytes as a string."""
    content = values.tobytes()
    return (
        b"c" + module + b"\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R(K\x01"
        b"K" + bytes([len(values)]) + b"\x85cnumpy\ndtype\nU\x02" + code + b"K\x00K\x01\x87R"
        b"(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89T"
        + struct.pack("<i", len(content))
        + content
        + b"tb"
    )


PICKLES = {f"protocol {p}.pkl": pickle.dumps(DATA, p) for p in (0, 2, 4, 5)}
PICKLES["python 2.pkl"] = b"\x80\x02" + old_array(np.arange(3.0), b"f8") + b"."

# pickle opcodes with small arguments, for use in any order: they reach states that random bytes rarely reach
PICKLE_PIECES = [
    b"cnumpy\nndarray\n", b"cnumpy\ndtype\n", b"cnumpy.core.multiarray\n_reconstruct\n",
    b"cnumpy.core.multiarray\nscalar\n",
    b"cnumpy._core.numeric\n_frombuffer\n", b"cchumpy.ch\nCh\n", b"cchumpy.reordering\nSelect\n", b"c_codecs\nencode\n",
    b"cscipy.sparse.csc\ncsc_matrix\n", b"ccopy_reg\n_reconstructor\n", b"ccollections\nOrderedDict\n",
    b"c__builtin__\nset\n",
    b"ccollections\ndefaultdict\n", b"c__builtin__\nobject\n", b"c__builtin__\ncomplex\n", b"c__builtin__\nbytearray\n",
    b"K\x00", b"K\x02", b"N", b"]", b"}", b")", b"\x8f", b"(", b"t", b"l", b"d", b"\x85", b"\x86", b"\x87", b"R", b"b",
    b"a", b"e", b"s", b"u", b"0", b"1", b"2", b"\x94", b"h\x00", b"h\x01", b"\x81", b"\x92", b"o", b"\x90", b"\x91",
    b"U\x02f8", b"U\x01x", b"U\x01a", b"U\x04idxs", b"U\x01O", b"C\x08abcdefgh", b"G" + b"\x00" * 8, b"U\x01C", b"\x88",
    b"cnumpy\nndarray\nK\x00\x85U\x01b\x87", b"(K\x01K\x01\x85", b"cnumpy\ndtype\nU\x02f8K\x00K\x01\x87R",
    b"(K\x03U\x01<NNN",
]  # fmt: skip


# ---- damage


@st.composite
def damaged(draw, files: dict[str, bytes]) -> tuple[str, bytes]:
    """Name and content of one of the files, with some bytes cut off, changed, inserted or repeated."""
    name = draw(st.sampled_from(sorted(files)))
    content = files[name]
    odd = st.binary(max_size=6) | st.sampled_from([b"9" * 25, b"\n", b" ", b"-", b",", b'"', b"nan", b"\xff" * 8])
    for kind in draw(st.lists(st.sampled_from(["cut", "change", "insert", "repeat"]), min_size=1, max_size=4)):
        at = draw(st.integers(0, len(content)))
        part = draw(odd)
        if kind == "cut":
            content = content[:at] if draw(st.booleans()) else content[:at] + content[at + len(part) :]
        elif kind == "repeat":
            length = draw(st.integers(1, 40))
            content = content[:at] + content[at : at + length] * draw(st.integers(2, 50)) + content[at + length :]
        else:
            content = content[:at] + part + content[at + (len(part) if kind == "change" else 0) :]
    return name, content
