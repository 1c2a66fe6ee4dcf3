"""Pickles: data is read as by pickle itself; all other names are refused, not imported and not called."""

import collections
import io
import os
import pickle
import struct
import subprocess
import sys

import numpy as np
import pytest
from hostile_files import DATA, old_array, refusal

from lidarpose.io import pickles
from lidarpose.io.pickles import MAX_BYTES, Unread, load_pickle


@pytest.fixture
def load(tmp_path):
    def loaded(data: bytes):
        path = tmp_path / "body.pkl"
        path.write_bytes(data)
        return load_pickle(path)

    return loaded


@pytest.fixture
def refused(load):
    def line(data: bytes) -> str:
        return refusal(load, data, words=["body.pkl: "]).split("body.pkl: ")[1]

    return line


def same(a, b):
    """Asserts equal types and contents, also of parts."""
    assert type(a) is type(b)
    if isinstance(a, np.ndarray):
        assert a.dtype == b.dtype and a.shape == b.shape
        a, b = a.ravel().tolist(), b.ravel().tolist()
    if isinstance(a, dict):
        a, b = list(a.items()), list(b.items())
    if not isinstance(a, list | tuple):
        assert a == b
        return
    for x, y in zip(a, b, strict=True):
        same(x, y)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_load_pickle_round_trip(load, protocol):
    same(load(pickle.dumps(DATA, protocol)), DATA)
    same(
        load(pickle.dumps(collections.OrderedDict(b=[1], a=collections.defaultdict(list, c=2)), protocol)),
        {"b": [1], "a": {"c": 2}},
    )
    assert load(pickle.dumps(bytearray(b"xy"), protocol)) == b"xy"
    assert load(pickle.dumps([np.dtype("<f4"), np.dtype(">i2")], protocol)) == [np.dtype("<f4"), np.dtype(">i2")]


def test_load_pickle_keeps_shared_objects(load):
    array, items = np.arange(3), [1]
    a, b, c, d = load(pickle.dumps([array, array, items, items]))
    assert a is b and c is d
    a[0] = 7
    assert b[0] == 7, "arrays can be written to"


def test_load_pickle_reads_python_2_pickles(load):
    values = np.array([1.5, -2.0, 1e300])
    same(load(b"\x80\x02" + old_array(values, b"f8") + b"."), values)
    # as dumped by protocol 0 and 1: quoted text, numbers in text, dict and list from marks
    text = b"(dp0\nS'it\\'s \\xfc\\n'\np1\n(lp2\nI1\naL5L\naI01\naF1.5\naVx\\u00e9\nas."
    assert load(text) == {"it's ü\n": [1, 5, True, 1.5, "xé"]}
    assert load(b"(i__builtin__\nset\n.") == set()
    assert load(b"c__builtin__\nset\n((lI1\naI2\natR.") == {1, 2}


def foreign(name: str, **state):
    """An object of a class of another library."""
    module, _, cls = name.rpartition(".")
    instance = type(cls, (), {"__module__": module})()
    instance.__dict__.update(state)
    return instance


class ForeignPickler(pickle._Pickler):
    """Pickles classes that do not exist in their modules."""

    dispatch = {
        **pickle._Pickler.dispatch,
        type: lambda self, kind: self.write(f"c{kind.__module__}\n{kind.__name__}\n".encode()),
    }


def dumped(value, protocol=2) -> bytes:
    file = io.BytesIO()
    ForeignPickler(file, protocol).dump(value)
    return file.getvalue()


def int32(*values):
    return np.array(values, np.int32)


CSC = dict(indptr=int32(0, 1, 2, 2, 3), indices=int32(1, 0, 0), data=np.array([3.0, 2, 1]), _shape=(2, 4))
CSR = dict(indptr=int32(0, 2, 3), indices=int32(1, 3, 0), data=np.array([2.0, 1, 3]), _shape=(2, 4))


@pytest.mark.parametrize("protocol", [0, 1, 2, 4])
def test_load_pickle_reads_smpl_without_chumpy_and_scipy(load, monkeypatch, protocol):
    x = np.arange(6.0).reshape(2, 3)
    ch = foreign("chumpy.ch.Ch", x=x, _dirty_vars={"x"}, _itr=None)
    content = {
        "v": ch,
        "s": foreign("chumpy.reordering.Select", a=ch, idxs=np.array([5, 0]), preferred_shape=(1, 2)),
        "p": foreign("chumpy.ch_ops.add", a=ch, b=ch),
        "csc": foreign("scipy.sparse.csc.csc_matrix", **CSC),
        "csr": foreign("scipy.sparse._csr.csr_matrix", **CSR),
        "style": "lbs",
    }
    for module in ("chumpy", "scipy"):
        # an import of them raises an error
        monkeypatch.setitem(sys.modules, module, None)
    body = load(dumped(content, protocol))
    np.testing.assert_array_equal(body["v"], x)
    np.testing.assert_array_equal(body["s"], [[5, 0]])
    for matrix in ("csc", "csr"):
        np.testing.assert_array_equal(body[matrix], [[0, 2.0, 0, 1], [3, 0, 0, 0]])
    assert body["p"] == Unread("chumpy.ch_ops.add") and body["style"] == "lbs"


@pytest.mark.parametrize(
    "wrong",
    [
        dict(_shape=(10**9, 10**9)), dict(_shape=(2, 3)), dict(_shape=(2, -4)), dict(_shape="24"),
        dict(indices=int32(1, 0, 2)), dict(indices=int32(-1, 0, 0)), dict(indptr=int32(0, 2, 1, 2, 3)),
        dict(indptr=int32(0, 10**9, 10**9, 10**9, 10**9)), dict(data=np.array([1.0])), dict(data=np.array([None] * 3)),
        dict(data=np.array([1, np.ones(99), 1], object)), dict(indices=np.array([0.5, 1, 1])),
        dict(indices=int32(1, 0, 0)[:, None]), dict(indptr=None),
    ],
)  # fmt: skip
def test_load_pickle_rejects_bad_sparse_matrices(refused, wrong):
    line = refused(dumped(foreign("scipy.sparse.csc.csc_matrix", **CSC | wrong)))
    assert "has a scipy.sparse.csc.csc_matrix" in line


def test_load_pickle_limits_total_of_sparse_matrices(load, refused, monkeypatch):
    empty = dict(indptr=int32(0, 0, 0, 0, 0), indices=int32(), data=np.zeros(0), _shape=(2, 4))
    two, three = (dumped([foreign("scipy.sparse.csc.csc_matrix", **empty) for _ in range(n)]) for n in (2, 3))
    monkeypatch.setattr(pickles, "MAX_DENSE", 16)
    assert [matrix.shape for matrix in load(two)] == [(2, 4)] * 2
    assert "up to 16 numbers are read in total" in refused(three)


class Evil:
    def __init__(self, call, *args):
        self.call, self.args = call, args

    def __reduce__(self):
        return self.call, self.args


def test_load_pickle_refuses_other_names_without_calling_them(refused, tmp_path, monkeypatch):
    mark = tmp_path / "ran"
    command = f"touch {mark}"
    for call, args, name in (
        (os.system, (command,), f"{os.name}.system"),
        (subprocess.call, (["touch", str(mark)],), "subprocess.call"),
        (eval, (f"open({str(mark)!r}, 'w')",), "builtins.eval"),
        (exec, (command,), "builtins.exec"),
        (getattr, (mark, "touch"), "builtins.getattr"),
        (np.load, (str(mark),), "numpy."),
        (np.testing.assert_equal, (1, 2), "numpy.testing"),
    ):
        line = refused(pickle.dumps({"v_template": Evil(call, *args)}, 4))
        assert name in line and "not on the list" in line and "get it as npz" in line
    for module, name in (("numpy.core", "multiarray._reconstruct.__globals__"), ("builtins", "__import__")):
        assert f"{module}.{name}" in refused(
            b"\x80\x04\x8c%c%s\x8c%c%s\x93." % (len(module), module.encode(), len(name), name.encode())
        )
    assert not mark.exists()
    # modules of allowed names are not imported either
    monkeypatch.setitem(sys.modules, "chumpy", None)
    refused(b"cos\nsystem\n(S'x'\ntR.")


def _announced(code: bytes, size: int) -> bytes:
    return b"\x80\x05" + code + struct.pack("<Q", size) + b"x."


HOSTILE = {
    "unsupported persistent id": [b"Pabc\n.", b"K\x01Q."],
    "registered number": [b"\x80\x02" + code + b"." for code in (b"\x82\x01", b"\x83\x01\0", b"\x84\x01\0\0\0")],
    "out-of-band data": [b"\x80\x05\x97."],
    # a state of a class, of a function, of plain values; calls of objects that are not functions
    "a state of a": [
        b"\x80\x02" + target + b"}b."
        for target in (b"cnumpy\nndarray\n", b"cnumpy.core.multiarray\n_reconstruct\n", b"]", b"}", b"K\x01")
    ],
    "not callable": [b"\x80\x02" + target + b")R." for target in (b"]", b"U\x01x", b"K\x01", b"cchumpy\nCh\n)R")],
    "a call of numpy.ndarray": [b"cnumpy\nndarray\n)R."],
    "without content": [b"cscipy.sparse.csc\ncsc_matrix\n)R."],
    "damaged": [b"\x80\x02j\x05\0\0\0.", b"]}K\x01K\x02s0(K\x01\x90.", b"cnumpy\ndtype\n)\x81N\x92."],
    # announced sizes that exceed the memory
    "cut off": [_announced(b"\x8e", 2**62), _announced(b"\x96", 2**40)],
    # a deeply nested tuple as a key would crash the interpreter
    "as a key": [b"})" + b"\x85" * 300_000 + b"Ns.", b"}]Ns.", pickle.dumps({k * (2**61 - 1): 0 for k in range(9)}, 2)],
    "nested more than": [b"]" * 200_000 + b"a" * 199_999 + b"."],
    "contains itself": [b"]q\x00h\x00a."],
}


@pytest.mark.long
@pytest.mark.parametrize("words", HOSTILE)
def test_load_pickle_rejects_hostile_opcodes(refused, words):
    for data in HOSTILE[words]:
        assert words in refused(data)


def test_load_pickle_accepts_odd_harmless_opcodes(load):
    # the last of 2**32 memo indices
    assert load(b"K\x07r\xff\xff\xff\xff0j\xff\xff\xff\xff.") == 7
    assert load(pickle.dumps({2**62: 1, -1: 2}, protocol=2)) == {2**62: 1, -1: 2}
    # references are not copied: 2**60 references to one list
    shared = load(b"]q\x00" + b"0(h\x00h\x00tq\x00" * 60 + b".")
    assert shared[0] is shared[1]


@pytest.mark.parametrize(
    "old, new, hint",
    [
        (b"K\x01K\x03\x85", b"K\x01K\x04\x85", "shape (4,) with 24 bytes"),
        (b"K\x01K\x03\x85", b"K\x01J\xfd\xff\xff\xff\x85", "shape (-3,)"),
        (b"K\x01K\x03\x85", b"K\x01\x8a\x08" + b"\xff" * 7 + b"\x7f\x85", "with 24 bytes"),
        (b"K\x01K\x03\x85", b"K\x01(" + b"K\xff" * 999 + b"t", "with 24 bytes"),
        (b"K\x01K\x03\x85", b"K\x01]", "without type or shape"),
        (b"U\x02f8", b"U\x01O", "an array of a bytes"),
        *((b"U\x02f8", b"U\x02" + code, f"of type '{code.decode()}'") for code in (b"M8", b"V8", b"U0")),
        (b"ndarray", b"dtype\n", "damaged"),
        (b"\x89T", b"\x89NT", "damaged"),
        (b"R(K\x01", b"R.", "without content"),
    ],
)
def test_load_pickle_rejects_hostile_arrays(refused, old, new, hint):
    array = old_array(np.arange(3.0), b"f8")
    assert old in array
    assert hint in refused(b"\x80\x02" + array.replace(old, new, 1) + b".")


@pytest.mark.long
def test_load_pickle_bounds_memory_and_time(load, refused):
    """In these files a few bytes refer to large earlier objects, have equal hashes, or create an object."""

    def list_of(shared: bytes, part: bytes, count: int) -> bytes:
        return b"\x80\x02(" + shared + b"q\x01" + part * count + b"l."

    array = old_array(np.zeros(1, np.uint8), b"u1")
    array = array[: array.index(b"T\x01")].replace(b"K\x01\x85", b"J" + struct.pack("<i", 20_000) + b"\x85")
    content = b"T" + struct.pack("<i", 20_000) + bytes(20_000)
    text = b"X" + struct.pack("<I", 20_000) + b"a" * 20_000
    assert len(load(list_of(content, array + b"h\x01tb", 6))) == 7
    for data in (
        list_of(content, array + b"h\x01tb", 60),
        list_of(text, b"c_codecs\nencode\nh\x01U\x06latin1\x86R", 60),
        list_of(b"(" + b"N" * 9_000 + b"t", b"c__builtin__\nlist\nh\x01\x85R", 60),
    ):
        assert "arrays larger than 8 times the file" in refused(data)
    # -1 and -2 have equal hashes, and so have all tuples of them
    tuples = [tuple(-1 - (i >> k & 1) for k in range(11)) for i in range(1_500)]
    assert len({hash(key) for key in tuples}) == 1
    with_text = [("a", *numbers) for numbers in tuples]
    assert len({hash(key) for key in with_text}) == 1
    for keys in (tuples, with_text, range(30_000), [float(i) for i in range(30_000)]):
        for data in (dict.fromkeys(keys), set(keys), frozenset(keys)):
            for protocol in (0, 2, 4):
                assert "as keys" in refused(pickle.dumps(data, protocol))
    # hashes of text are randomized, also within a tuple
    many = {key: None for i in range(30_000) for key in (str(i), ("a", i))}
    assert load(pickle.dumps(many)) == many
    # equal keys in many dicts are not collisions
    again = [{("a", k): None} for k in (1, 2) for _ in range(1_500)]
    assert load(pickle.dumps(again)) == again
    # work that is repeated for each reference to one long object
    numbers = b"(" + b"K\x01" * 10_000 + b"t"
    assert "a tuple of 10000 as a key" in refused(list_of(numbers, b"}h\x01Ns", 10))
    assert "can't multiply" in refused(list_of(text, b"c__builtin__\ncomplex\nh\x01K\x01\x86R", 10))
    # numbers with equal hashes as memo indices
    assert "more than 32 bits" in refused(b"Np%d\n." % (2**61 - 1))


def test_load_pickle_reports_bad_files(load, refused, tmp_path):
    refusal(load_pickle, tmp_path / "none.pkl", words=["no such file; expected a pickle"])
    refusal(load_pickle, tmp_path, words=["got a folder"])
    assert "is empty" in refused(b"")
    assert "got a zip archive" in refused(b"PK\x03\x04 a zip archive")
    assert "damaged or not a pickle" in refused(b"{'json': 1}")
    whole = pickle.dumps(DATA)
    assert "cut off" in refused(whole[: len(whole) // 2])
    huge = tmp_path / "huge.pkl"
    with huge.open("wb") as file:
        file.truncate(MAX_BYTES + 1)
    refusal(load_pickle, huge, words=["has 4.0 GiB, expected at most 4 GiB"])
