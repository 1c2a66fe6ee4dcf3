"""Pickles: data comes out as pickle itself would give it, nothing else is named, called or imported."""

import collections
import copy
import os
import pickle
import struct
import subprocess
import sys
import types

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarpose.errors import InputError
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
        with pytest.raises(InputError) as caught:
            load(data)
        assert "\n" not in str(caught.value) and "body.pkl: " in str(caught.value)
        return str(caught.value).split("body.pkl: ")[1]

    return line


def same(a, b):
    assert type(a) is type(b)
    if isinstance(a, np.ndarray):
        assert a.dtype == b.dtype and a.shape == b.shape
        if a.dtype == object:
            for x, y in zip(a.flat, b.flat, strict=True):
                same(x, y)
        else:
            np.testing.assert_array_equal(a, b)
    elif isinstance(a, dict):
        assert list(a) == list(b)
        for key in a:
            same(a[key], b[key])
    elif isinstance(a, list | tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            same(x, y)
    else:
        assert a == b


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


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_data_comes_out_as_it_went_in(load, protocol):
    same(load(pickle.dumps(DATA, protocol)), DATA)
    kept = load(pickle.dumps(collections.OrderedDict(b=[1], a=collections.defaultdict(list, c=2)), protocol))
    assert kept == {"b": [1], "a": {"c": 2}} and type(kept) is dict and type(kept["a"]) is dict
    assert load(pickle.dumps(bytearray(b"xy"), protocol)) == b"xy"
    assert load(pickle.dumps([np.dtype("<f4"), np.dtype(">i2")], protocol)) == [np.dtype("<f4"), np.dtype(">i2")]


def test_what_is_shared_stays_shared(load):
    array, items = np.arange(3), [1]
    a, b, c, d = load(pickle.dumps([array, array, items, items]))
    assert a is b and c is d
    a[0] = 7
    assert b[0] == 7, "arrays can be written to"


def old_array(values: np.ndarray, code: bytes, module: bytes = b"numpy.core.multiarray") -> bytes:
    """As Python 2 and an old numpy wrote an array: its bytes as a string."""
    content = values.tobytes()
    return (
        b"c" + module + b"\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R(K\x01"
        b"K" + bytes([len(values)]) + b"\x85cnumpy\ndtype\nU\x02" + code + b"K\x00K\x01\x87R"
        b"(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89T"
        + struct.pack("<i", len(content))
        + content
        + b"tb"
    )


def test_python_2_pickles(load):
    values = np.array([1.5, -2.0, 1e300])
    same(load(b"\x80\x02" + old_array(values, b"f8") + b"."), values)
    # as dumped by protocol 0 and 1: quoted text, numbers in text, dict and list from marks
    text = b"(dp0\nS'it\\'s \\xfc\\n'\np1\n(lp2\nI1\naL5L\naI01\naF1.5\naVx\\u00e9\nas."
    assert load(text) == {"it's ü\n": [1, 5, True, 1.5, "xé"]}
    assert load(b"(i__builtin__\nset\n.") == set()
    assert load(b"c__builtin__\nset\n((lI1\naI2\natR.") == {1, 2}


@pytest.fixture
def foreign(monkeypatch):
    """Makes classes under the names that SMPL's pickles use, and removes them before the file is read."""

    def made(name: str, state: dict):
        module, _, cls = name.rpartition(".")
        holder = types.ModuleType(module)
        kind = type(cls, (), {"__module__": module})
        setattr(holder, cls, kind)
        instance = kind()
        instance.__dict__.update(state)
        for i in range(len(module.split("."))):
            part = ".".join(module.split(".")[: i + 1])
            monkeypatch.setitem(sys.modules, part, holder)
        return instance

    yield made


def dumped(monkeypatch, value, protocol=2) -> bytes:
    data = pickle.dumps(value, protocol)
    for name in [
        m for m in sys.modules if m.split(".")[0] in ("chumpy", "scipy") and not hasattr(sys.modules[m], "__file__")
    ]:
        monkeypatch.delitem(sys.modules, name)
    return data


@pytest.mark.parametrize("protocol", [0, 1, 2, 4])
def test_smpl_like_pickles_need_neither_chumpy_nor_scipy(load, foreign, monkeypatch, protocol):
    x = np.arange(6.0).reshape(2, 3)
    regressor = np.array([[0, 2.0, 0, 1], [3, 0, 0, 0]])
    parts = dict(
        indptr=np.int32([0, 1, 2, 2, 3]), indices=np.int32([1, 0, 0]), data=np.array([3.0, 2, 1]), _shape=(2, 4)
    )
    lines = dict(indptr=np.int32([0, 2, 3]), indices=np.int32([1, 3, 0]), data=np.array([2.0, 1, 3]), _shape=(2, 4))
    ch = foreign("chumpy.ch.Ch", {"x": x, "_dirty_vars": {"x"}, "_itr": None})
    picked = foreign("chumpy.reordering.Select", {"a": ch, "idxs": np.array([5, 0]), "preferred_shape": (1, 2)})
    product = foreign("chumpy.ch_ops.add", {"a": ch, "b": ch})
    csc = foreign("scipy.sparse.csc.csc_matrix", parts)
    csr = foreign("scipy.sparse._csr.csr_matrix", lines)
    data = dumped(monkeypatch, dict(v=ch, s=picked, p=product, csc=csc, csr=csr, style="lbs"), protocol)
    before = set(sys.modules)
    body = load(data)
    assert not {m for m in set(sys.modules) - before if m.split(".")[0] in ("chumpy", "scipy")}
    np.testing.assert_array_equal(body["v"], x)
    np.testing.assert_array_equal(body["s"], [[5, 0]])
    np.testing.assert_array_equal(body["csc"], regressor)
    np.testing.assert_array_equal(body["csr"], regressor)
    assert body["p"] == Unread("chumpy.ch_ops.add") and body["style"] == "lbs"


@pytest.mark.parametrize(
    "wrong",
    [
        dict(_shape=(10**9, 10**9)), dict(_shape=(2, 3)), dict(_shape=(2, -4)), dict(_shape="24"),
        dict(indices=np.int32([1, 0, 2])), dict(indices=np.int32([-1, 0, 0])), dict(indptr=np.int32([0, 2, 1, 2, 3])),
        dict(data=np.array([1.0])), dict(data=np.array([None] * 3)), dict(indices=np.array([0.5, 1, 1])),
        dict(indptr=None),
    ],
)  # fmt: skip
def test_wrong_sparse_matrices(refused, foreign, monkeypatch, wrong):
    parts = dict(
        indptr=np.int32([0, 1, 2, 2, 3]), indices=np.int32([1, 0, 0]), data=np.array([3.0, 2, 1]), _shape=(2, 4)
    )
    data = dumped(monkeypatch, foreign("scipy.sparse.csc.csc_matrix", parts | wrong))
    assert "has a scipy.sparse.csc.csc_matrix" in refused(data)


def test_sparse_matrices_are_counted_together(load, refused, foreign, monkeypatch):
    parts = dict(indptr=np.zeros(5, np.int32), indices=np.zeros(0, np.int32), data=np.zeros(0), _shape=(2, 4))
    two, three = (
        dumped(monkeypatch, [copy.copy(matrix) for matrix in [foreign("scipy.sparse.csc.csc_matrix", parts)] * count])
        for count in (2, 3)
    )
    monkeypatch.setattr(pickles, "MAX_DENSE", 16)
    assert [one.shape for one in load(two)] == [(2, 4)] * 2
    assert "up to 16 numbers are read in all" in refused(three)


class Evil:
    def __init__(self, call, *args):
        self.call, self.args = call, args

    def __reduce__(self):
        return self.call, self.args


def test_whatever_else_is_named_is_refused_by_name_and_not_run(refused, tmp_path, monkeypatch):
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
        assert name in line and "not on the list" in line and "ask for npz" in line
    for module, name in (("numpy.core", "multiarray._reconstruct.__globals__"), ("builtins", "__import__")):
        assert f"{module}.{name}" in refused(
            b"\x80\x04\x8c%c%s\x8c%c%s\x93." % (len(module), module.encode(), len(name), name.encode())
        )
    assert not mark.exists()
    # modules of names that are allowed are not imported either
    monkeypatch.setitem(sys.modules, "chumpy", None)
    refused(b"cos\nsystem\n(S'x'\ntR.")


def test_hostile_instructions(refused, load):
    assert "persistent id" in refused(b"Pabc\n.")
    assert "persistent id" in refused(b"K\x01Q.")
    for code in (b"\x82\x01", b"\x83\x01\x00", b"\x84\x01\x00\x00\x00"):
        assert "registered number" in refused(b"\x80\x02" + code + b".")
    assert "outside of the file" in refused(b"\x80\x05\x97.")
    # the state of a class, of a function, of plain values
    for target in (b"cnumpy\nndarray\n", b"cnumpy.core.multiarray\n_reconstruct\n", b"]", b"}", b"K\x01"):
        assert "damaged" in refused(b"\x80\x02" + target + b"}b.")
    # calls of what is no function
    for target in (b"]", b"U\x01x", b"K\x01", b"cchumpy\nCh\n)R"):
        assert "damaged" in refused(b"\x80\x02" + target + b")R.")
    # memory: announced sizes and places in the memo
    assert "cut off" in refused(b"\x80\x04\x8e" + struct.pack("<Q", 2**62) + b"x.")
    assert "cut off" in refused(b"\x80\x05\x96" + struct.pack("<Q", 2**40) + b".")
    assert load(b"K\x07r\xff\xff\xff\xff0j\xff\xff\xff\xff.") == 7
    assert "damaged" in refused(b"\x80\x02j\x05\x00\x00\x00.")
    # a nested tuple as a key would end the interpreter
    assert "as a key" in refused(b"})" + b"\x85" * 300_000 + b"Ns.")
    assert "nested more than" in refused(b"]" * 200_000 + b"a" * 199_999 + b".")
    assert "contains itself" in refused(b"]q\x00h\x00a.")
    assert "as a key" in refused(b"}]Ns.")
    # numbers that share one hash
    assert "as a key" in refused(pickle.dumps({k * (2**61 - 1): 0 for k in range(9)}, protocol=2))
    assert load(pickle.dumps({2**62: 1, -1: 2}, protocol=2)) == {2**62: 1, -1: 2}
    # sharing is no copy: 2**60 references to one list
    shared = load(b"]q\x00" + b"0(h\x00h\x00tq\x00" * 60 + b".")
    assert shared[0] is shared[1]


def test_hostile_arrays(refused):
    good = old_array(np.arange(3.0), b"f8")
    head = b"\x80\x02"
    for old, new, hint in (
        (b"K\x01K\x03\x85", b"K\x01K\x04\x85", "shape (4,) with 24 bytes"),
        (b"K\x01K\x03\x85", b"K\x01J\xfd\xff\xff\xff\x85", "shape (-3,)"),
        (b"K\x01K\x03\x85", b"K\x01\x8a\x08" + b"\xff" * 7 + b"\x7f\x85", "with 24 bytes"),
        (b"K\x01K\x03\x85", b"K\x01]", "without type or shape"),
        (b"U\x02f8", b"U\x01O", "an array of a bytes"),
        (b"U\x02f8", b"U\x02M8", "of type 'M8'"),
        (b"U\x02f8", b"U\x02V8", "of type 'V8'"),
        (b"U\x02f8", b"U\x02U0", "with 24 bytes"),
        (b"<NNN", b"<N]N", "derived from"),
        (b"ndarray", b"dtype\n", "unknown class|damaged"),
        (b"\x89T", b"\x89NT", "with|without"),
    ):
        assert old in good
        with pytest.raises(AssertionError):
            assert good.replace(old, new) == good
        line = refused(head + good.replace(old, new, 1) + b".")
        assert any(part in line for part in hint.split("|")), (new, line)
    assert "without content" in refused(head + good[: good.index(b"R(") + 1] + b".")


def test_memory_and_time_stay_in_proportion_to_the_file(load, refused, monkeypatch):
    """A few bytes each refer to what was read before, have one hash with all others, or make an object."""

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
        assert "arrays of more than 8 times its size" in refused(data)
    # -1 and -2 have one hash, and so have all tuples of them
    tuples = [tuple(-1 - (i >> k & 1) for k in range(11)) for i in range(1_500)]
    assert len({hash(key) for key in tuples}) == 1
    for keys in (tuples, range(30_000), [float(i) for i in range(30_000)]):
        for data in (dict.fromkeys(keys), set(keys), frozenset(keys)):
            for protocol in (0, 2, 4):
                assert "as keys" in refused(pickle.dumps(data, protocol))
    # text is hashed with a secret, alone and within a tuple
    many = {key: None for i in range(30_000) for key in (str(i), ("a", i))}
    assert load(pickle.dumps(many)) == many
    monkeypatch.setattr(pickles, "_STEPS", 1_000)
    assert load(b"(" + b"K\x01" * 1_900 + b"l.") == [1] * 1_900
    for part in (b"\x8f", b"]", b"(", b"N\x94"):
        assert "too many small parts" in refused(b"\x80\x04(" + part * 3_000 + b"l.")


def test_files(load, refused, tmp_path):
    with pytest.raises(InputError, match="no such file; expected a pickle"):
        load_pickle(tmp_path / "none.pkl")
    with pytest.raises(InputError, match="got a folder"):
        load_pickle(tmp_path)
    assert "is empty" in refused(b"")
    assert "got a zip archive" in refused(b"PK\x03\x04 a zip archive")
    assert "damaged or no pickle" in refused(b"{'json': 1}")
    whole = pickle.dumps(DATA)
    assert "cut off" in refused(whole[: len(whole) // 2])
    huge = tmp_path / "huge.pkl"
    with huge.open("wb") as file:
        file.truncate(MAX_BYTES + 1)
    with pytest.raises(InputError, match="has 4.0 GiB, 4 GiB are read at most"):
        load_pickle(huge)


VALID = [pickle.dumps(DATA, p) for p in (0, 2, 4, 5)] + [b"\x80\x02" + old_array(np.arange(3.0), b"f8") + b"."]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz") / "f.pkl"


def read_or_refuse(place, data):
    place.write_bytes(data)
    try:
        load_pickle(place)
    except InputError as error:
        assert "\n" not in str(error)


@settings(max_examples=400, deadline=None)
@given(data=st.binary(max_size=80))
def test_random_bytes_are_refused_in_one_line(place, data):
    read_or_refuse(place, data)
    read_or_refuse(place, b"\x80\x02" + data + b".")


@settings(max_examples=400, deadline=None)
@given(
    valid=st.sampled_from(VALID),
    changes=st.lists(st.tuples(st.floats(0, 1), st.binary(min_size=0, max_size=4), st.integers(0, 4)), max_size=6),
)
def test_changed_pickles_are_read_or_refused_in_one_line(place, valid, changes):
    data = valid
    for where, put, drop in changes:
        at = int(where * len(data))
        data = data[:at] + put + data[at + drop :]
    read_or_refuse(place, data)


# instructions in any order, with small arguments: reaches what random bytes hardly ever do
PIECES = [
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


@settings(max_examples=600, deadline=None)
@given(st.lists(st.sampled_from(PIECES), max_size=40))
def test_any_order_of_instructions_is_read_or_refused(place, pieces):
    read_or_refuse(place, b"".join(pieces) + b".")
