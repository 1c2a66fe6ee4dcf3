"""Reading pickles of data without running them: SMPL's `.pkl`, SLOPER4D's and Human-M3's labels.

A pickle may call any function of the machine it is read on. `load_pickle` knows only the names of `_MEANINGS`, of
chumpy and of scipy.sparse; whatever else a file names is refused, and nothing of the file is ever imported or called.
"""

import math
import os
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from lidarpose.io.files import file_error, read_bytes
from lidarpose.io.headers import Problem, shorten
from lidarpose.io.pickle_machine import PLAIN, Call, Named, run

# larger files do not hold labels or a body; they would be in memory three times
MAX_BYTES = 4 * 2**30
# how deep lists and dicts may be nested (chosen: data sets have less than ten levels)
MAX_DEPTH = 100
# sparse matrices become dense ones, together of at most so many numbers: SMPL-X's largest has 0.6 million
MAX_DENSE = 20_000_000


@dataclass(frozen=True)
class Unread:
    """Stands for an object that holds no numbers which can be read, of the class or function "module.name"."""

    name: str


def load_pickle(path: str | os.PathLike) -> object:
    """The data of a pickle: dicts, lists, tuples, sets, numbers, text, bytes and numpy arrays.

    chumpy's arrays and scipy's csc and csr matrices come as (dense) arrays, strings of Python 2 as latin-1 text,
    OrderedDict and defaultdict as dict, an expression of chumpy as `Unread`.

    Raises InputError, on one line: a file that is missing, empty, cut off, damaged or over 4 GiB; a class or function
    that is not on the list, by its name; data that contains itself.
    """
    size = 0
    with suppress(OSError, TypeError, ValueError):
        size = os.path.getsize(path)
    if size > MAX_BYTES:
        raise file_error(
            path, f"has {size / 2**30:.1f} GiB, {MAX_BYTES / 2**30:g} GiB are read at most: split it first"
        )
    data = read_bytes(path, expected="a pickle")
    if data.startswith(_ZIP):
        raise file_error(path, "expected a pickle, got a zip archive: an npz, if so name it .npz")
    try:
        return _Reader().value(run(data, _is_allowed), 0)
    except Problem as problem:
        raise file_error(path, problem) from None
    except MemoryError:
        raise file_error(path, "does not fit in memory: ask for npz, or split it") from None
    # what numpy says to wrong shapes and types
    except (ValueError, TypeError, OverflowError, IndexError) as error:
        raise file_error(path, f"holds a wrong array ({shorten(str(error))}): copy it again, or ask for npz") from None


class _Reader:
    """What the pickle's values mean. Each is looked at once, however often it is referred to."""

    def __init__(self):
        self.done: dict[int, object] = {}
        self.dense = 0

    def value(self, found: object, depth: int) -> object:
        if type(found) in PLAIN:
            return found
        if isinstance(found, Named):
            return Unread(_canonical(found.name))
        if depth > MAX_DEPTH:
            raise Problem(f"is nested more than {MAX_DEPTH} levels deep: ask for npz")
        key = id(found)
        if key not in self.done:
            self.done[key] = _BEGUN
            self.done[key] = self._made(found, depth + 1)
        elif self.done[key] is _BEGUN:
            raise Problem("holds a list or dict that contains itself: ask for npz")
        return self.done[key]

    def _made(self, found: object, depth: int) -> object:
        if isinstance(found, dict):
            return self._dict(found.items(), depth)
        if isinstance(found, list | tuple | set | frozenset):
            items = [x if type(x) in PLAIN else self.value(x, depth) for x in found]
            if isinstance(found, set | frozenset):
                items = [_key(x) for x in items]
            return type(found)(items)
        return self._called(found, depth)

    def _dict(self, pairs, depth: int) -> dict:
        return {_key(self.value(key, depth)): self.value(value, depth) for key, value in pairs}

    def _called(self, call: Call, depth: int) -> object:
        name = _canonical(call.what.name)
        args, state = self.value(call.args, depth), self.value(call.state, depth)
        if name in _NEW and args and isinstance(args[0], Unread):
            name, args = args[0].name, args[1:]
        if name in _DICTS:
            return {_key(k): v for k, v in _pairs(name, args)} | self._dict(call.pairs, depth)
        if call.pairs or call.items:
            raise Problem(f"adds items to a {name}: copy it again, or ask for npz")
        if name.startswith("chumpy."):
            return _chumpy(name, state)
        if _SPARSE.fullmatch(name):
            made = _dense(name, state, MAX_DENSE - self.dense)
            self.dense += made.size
            return made
        if name not in _MEANINGS:
            return Unread(name)
        return _MEANINGS[name](args, state)


_ZIP = b"PK\x03\x04"
# in `_Reader.done` while a value is being made
_BEGUN = object()
_NEW = ("copyreg._reconstructor", "copyreg.__newobj__")
_DICTS = ("collections.OrderedDict", "collections.defaultdict", "builtins.dict")
_SPARSE = re.compile(r"scipy\.sparse\.([a-z_]+\.)?(csc|csr)_(matrix|array)")


def _canonical(name: str) -> str:
    """Python 2's and numpy 2's names as those of Python 3 and of the older numpy."""
    for other, usual in (("__builtin__.", "builtins."), ("copy_reg.", "copyreg."), ("numpy._core.", "numpy.core.")):
        if name.startswith(other):
            return usual + name.removeprefix(other)
    return name


def _is_allowed(name: str) -> bool:
    name = _canonical(name)
    known = name in _MEANINGS or name in _NEW or name in _DICTS or name in ("numpy.ndarray", "builtins.object")
    return known or name.startswith("chumpy.") or _SPARSE.fullmatch(name) is not None


def _key(value: object) -> object:
    parts = value if isinstance(value, tuple) else (value,)
    if not all(type(part) in PLAIN or isinstance(part, np.generic) for part in parts):
        raise Problem(f"has a {type(value).__name__} as a key: ask for npz")
    return value


def _pairs(name: str, args: tuple) -> list:
    """What a dict is made from: pairs or nothing; a defaultdict's factory is left out."""
    if name == "collections.defaultdict":
        args = args[1:]
    pairs = args[0] if args else []
    pairs = list(pairs.items()) if isinstance(pairs, dict) else pairs
    if (
        len(args) > 1
        or not isinstance(pairs, list)
        or not all(isinstance(p, list | tuple) and len(p) == 2 for p in pairs)
    ):
        raise Problem(f"makes a {name} of something else than pairs: copy it again, or ask for npz")
    return pairs


# --- numpy


def _dtype(args: tuple, state: object) -> np.dtype:
    code = args[0] if args else None
    if not isinstance(code, str) or not re.fullmatch(
        r"[|<>=]?(b1|[iu][1248]|f(2|4|8|16)|c(8|16|32)|[SU]\d{1,9}|O\d*|\?)", code
    ):
        raise Problem(f"has arrays of type {shorten(repr(code))}; numbers and text are read: ask for npz")
    if code[-1] == "O" or "O" in code:
        return np.dtype(object)
    order = ""
    if state is not None:
        if not isinstance(state, tuple) or len(state) < 5 or any(x is not None for x in state[2:5]):
            raise Problem(f"has arrays of a type derived from {code}; plain numbers and text are read: ask for npz")
        order = state[1] if isinstance(state[1], str) and state[1] in ("<", ">", "|", "=") else ""
    return np.dtype(order + code.lstrip("|<>="))


def _bytes(data: object) -> bytes:
    """An array's content; Python 2 kept it as text."""
    data = data.encode("latin1") if isinstance(data, str) else data
    if not isinstance(data, bytes | bytearray):
        raise Problem(f"has an array of {type(data).__name__}: copy it again, or ask for npz")
    return data


def _array_of(data: object, dtype: object, shape: object, order: str) -> np.ndarray:
    if (
        not isinstance(dtype, np.dtype)
        or not isinstance(shape, tuple)
        or not all(type(n) is int and n >= 0 for n in shape)
    ):
        raise Problem("has an array without type or shape: copy it again, or ask for npz")
    count = math.prod(shape)
    if dtype.kind == "O":
        if not isinstance(data, list) or len(data) != count:
            raise Problem(f"has an array of shape {shape} with other contents: copy it again, or ask for npz")
        flat = np.empty(count, object)
        for i, item in enumerate(data):
            flat[i] = item
    else:
        data = _bytes(data)
        if len(data) != count * dtype.itemsize or (count and not dtype.itemsize):
            raise Problem(f"has an array of shape {shape} with {len(data)} bytes: copy it again, or ask for npz")
        flat = np.frombuffer(data, dtype).copy() if count else np.empty(0, dtype)
    return flat.reshape(shape, order=order)


def _array(args: tuple, state: object) -> np.ndarray:
    if not args or args[0] != Unread("numpy.ndarray"):
        raise Problem("has an array of an unknown class: ask for npz")
    if not isinstance(state, tuple) or len(state) != 5:
        raise Problem("has an array without content: copy it again, or ask for npz")
    _, shape, dtype, fortran, data = state
    return _array_of(data, dtype, shape, "F" if fortran else "C")


def _array_from_buffer(args: tuple, state: object) -> np.ndarray:
    data, dtype, shape, order = args
    return _array_of(data, dtype, shape, "F" if order == "F" else "C")


def _scalar(args: tuple, state: object) -> np.generic:
    dtype, data = args
    if not isinstance(dtype, np.dtype) or dtype.kind == "O":
        raise Problem("has a number of type object: ask for npz")
    return _array_of(data, dtype, (), "C")[()]


# --- chumpy and scipy


def _chumpy(name: str, state: object) -> np.ndarray | Unread:
    """A Ch holds its numbers as `x`; a Select is a choice from another, by flat indices."""
    if not isinstance(state, dict):
        return Unread(name)
    if name == "chumpy.reordering.Select" and isinstance(state.get("a"), np.ndarray):
        picked = state["a"].ravel()[np.asarray(state.get("idxs"), np.int64)]
        shape = state.get("preferred_shape")
        return picked if shape is None else picked.reshape(shape)
    return state["x"] if isinstance(state.get("x"), np.ndarray) else Unread(name)


def _dense(name: str, state: object, most: int) -> np.ndarray:
    """A compressed sparse matrix, of at most so many numbers: indptr (lines + 1,), indices and data (entries,)."""
    state = state if isinstance(state, dict) else {}
    shape = state.get("_shape", state.get("shape"))
    pieces = [state.get(part) for part in ("indptr", "indices", "data")]
    if (
        not isinstance(shape, tuple)
        or len(shape) != 2
        or not all(isinstance(p, np.ndarray) and p.ndim == 1 for p in pieces)
    ):
        raise Problem(f"has a {name} without its parts: copy it again, or ask for npz")
    rows, columns = (int(n) for n in shape)
    by_column = "csc" in name
    lines, across = (columns, rows) if by_column else (rows, columns)
    if min(shape) < 0 or rows * columns > most:
        raise Problem(f"has a {name} of {rows} x {columns}; up to {MAX_DENSE} numbers are read in all: ask for npz")
    start, index, data = pieces
    wrong = (
        len(start) != lines + 1
        or len(index) != len(data)
        or start.dtype.kind not in "iu"
        or data.dtype.kind not in "fiub"
    )
    wrong = (
        wrong or index.dtype.kind not in "iu" or start[0] != 0 or start[-1] != len(data) or (np.diff(start) < 0).any()
    )
    if wrong or (len(index) and not 0 <= index.min() <= index.max() < across):
        raise Problem(f"has a {name} whose parts do not fit together: copy it again, or ask for npz")
    dense = np.zeros((lines, across), data.dtype)
    np.add.at(dense, (np.repeat(np.arange(lines), np.diff(start)), index), data)
    return dense.T.copy() if by_column else dense


# --- Python's own


def _items(kind: type) -> Callable[[tuple, object], object]:
    def make(args: tuple, state: object):
        items = args[0] if args else ()
        if len(args) > 1 or not isinstance(items, list | tuple | set | frozenset):
            raise Problem(f"makes a {kind.__name__} of something else than items: copy it again, or ask for npz")
        return kind(_key(x) for x in items) if kind in (set, frozenset) else kind(items)

    return make


def _encoded(args: tuple, state: object) -> bytes:
    """How Python 3 writes bytes for Python 2: as text and its encoding."""
    if not args or isinstance(args[0], bytes):
        return args[0] if args else b""
    if len(args) != 2 or not isinstance(args[0], str) or args[1] not in ("latin1", "latin-1"):
        raise Problem("makes bytes of something else than latin-1 text: copy it again, or ask for npz")
    return args[0].encode("latin1")


def _complex(args: tuple, state: object) -> complex:
    real, imaginary = args
    if type(real) not in (int, float) or type(imaginary) not in (int, float):
        raise Problem("makes a complex number of something else than numbers: copy it again, or ask for npz")
    return complex(real, imaginary)


# what the names on the list mean: (arguments, state) -> value
_MEANINGS = {
    "numpy.dtype": _dtype,
    "numpy.core.multiarray._reconstruct": _array,
    "numpy.core.multiarray.scalar": _scalar,
    "numpy.core.numeric._frombuffer": _array_from_buffer,
    "_codecs.encode": _encoded,
    "builtins.bytes": _encoded,
    "builtins.bytearray": _encoded,
    "builtins.complex": _complex,
    "builtins.list": _items(list),
    "builtins.tuple": _items(tuple),
    "builtins.set": _items(set),
    "builtins.frozenset": _items(frozenset),
}
