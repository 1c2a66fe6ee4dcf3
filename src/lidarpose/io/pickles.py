"""Reading pickled data without executing the pickles: SMPL's `.pkl`, labels of SLOPER4D and Human-M3.

A pickle may call any function of the machine that reads it. Here Python's own unpickler gets a stand-in object for
each name on an allowlist, and an error for every other name. The code below decides what a call of an allowed name
does, so nothing named in the file is ever imported or called. Memory and time stay proportional to the file size: an
instruction, which has at least one byte, takes at most 0.3 kB, and both copied data and keys whose hashes a file can
choose are counted.
"""

import io
import math
import operator
import os
import pickle
import re
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from lidarpose.io.files import FormatError, file_error, read_bytes, shorten

# larger files are not labels or body models, and their content would be in memory three times
MAX_BYTES = 4 * 2**30
# maximum nesting depth of lists and dicts (chosen: data sets have less than ten levels)
MAX_DEPTH = 100
# maximum number of values in all sparse matrices together, which are made dense: SMPL-X's largest has 0.6 million
MAX_DENSE = 20_000_000
# a file can make the hashes of keys without text collide: these numbers of keys take a second at most in any case
MAX_NUMBER_KEYS, MAX_TUPLE_KEYS = 20_000, 1_000
# a tuple is hashed again at every lookup, so its length is limited, too
MAX_KEY_PARTS = 16
# limit on copied bytes: this constant plus this multiple of the file size. Arrays and lists are copied out of the file,
# some of them two or three times, since Python 2 stored them as text
_FREE_COPIES, _COPIES = 4096, 8

# types of values without parts
_PLAIN = frozenset({type(None), bool, int, float, complex, str, bytes})
_CONTAINERS = (list, tuple, set, frozenset, dict)
_REMEDY = "copy it again, or get it as npz"


@dataclass(frozen=True)
class Unread:
    """Stands for a class or function "module.name", or for an instance of it that has no readable numbers."""

    name: str


def load_pickle(path: str | os.PathLike) -> Any:
    """The data of a pickle: dicts, lists, tuples, sets, numbers, text, bytes and numpy arrays.

    chumpy arrays and scipy's csc and csr matrices are returned as (dense) arrays, Python 2 strings as latin-1 text,
    OrderedDict and defaultdict as dict, and chumpy expressions as `Unread`.

    Raises a one-line InputError if the file is missing, empty, cut off, damaged or over 4 GiB, if it names a class or
    function that is not on the allowlist (the message names it), or if its data contains itself or grows far beyond
    the file size.
    """
    data = read_bytes(path, expected="a pickle", most=MAX_BYTES)
    if data.startswith(b"PK\x03\x04"):
        raise file_error(path, "expected a pickle, got a zip archive: if it is an npz, rename it to .npz")
    try:
        content = _DataUnpickler(data).load()
        _check_levels(content, {})
        return content
    except FormatError as problem:
        raise file_error(path, problem) from None
    except MemoryError:
        raise file_error(path, "does not fit in memory: get it as npz, or split it") from None
    except (EOFError, struct.error):
        raise file_error(path, f"is cut off: the pickle has no end; {_REMEDY}") from None
    # a damaged file can make the unpickler and numpy raise any exception
    except Exception as error:
        reason = shorten(str(error)) or type(error).__name__
        raise file_error(path, f"is damaged or not a pickle ({reason}): {_REMEDY}") from None


@dataclass(frozen=True)
class _Name(Unread):
    """A callable for a name on the allowlist; no other object that the unpickler creates can be called."""

    run: Callable[[str, tuple], object]

    def __call__(self, *args: object) -> object:
        return self.run(self.name, args)


@dataclass(frozen=True, eq=False)
class _Stub(Unread):
    """The result of a call that does not have its state yet; `value` is set with the state."""

    args: tuple
    value: Any = None


class _Memo(dict):
    """The unpickler's memo, which returns the final value for a stub that has received its state."""

    def __setitem__(self, key: int, value: object) -> None:
        # larger keys could all have the same hash
        if key >= 2**32:
            raise TypeError("a number of more than 32 bits in the memo")
        super().__setitem__(key, value)

    def __getitem__(self, key: int) -> object:
        value = super().__getitem__(key)
        return value.value if type(value) is _Stub and value.value is not None else value


class _DataUnpickler(pickle._Unpickler):
    """Python's unpickler with safe versions of all instructions that call, set a state or hash: they accept plain data.

    The base is the pure Python class, since it does not allocate announced sizes and its instructions can be replaced.
    """

    dispatch: ClassVar[dict[int, Any]] = dict(pickle._Unpickler.dispatch)
    # attributes of the base class that are missing in its type stubs
    append: Callable[[object], None]
    pop_mark: Callable[[], list]
    stack: list[Any]

    def __init__(self, data: bytes):
        super().__init__(io.BytesIO(data), encoding="latin1")
        self.memo = _Memo()
        self.copies_left = _FREE_COPIES + _COPIES * len(data)
        self.dense_left = MAX_DENSE
        self.key_share = 0.0
        # tuples that were used as keys, one for each hash
        self.tuples: dict[int, tuple] = {}

    def find_class(self, module: str, name: str) -> _Name:
        name = f"{_MODULES.get(module, module)}.{name}"
        if name not in _KNOWN and not name.startswith("chumpy.") and not _SPARSE.fullmatch(name):
            raise FormatError(
                f"its pickle needs {shorten(name)}, which is not on the list of plain data (arrays, lists, dicts, "
                "chumpy, scipy.sparse): nothing was run; get it as npz"
            )
        return _Name(name, self.call)

    def get_extension(self, code: int) -> None:
        raise FormatError(
            "its pickle needs a class by a registered number, known to its own program alone: get it as npz"
        )

    def call(self, name: str, args: tuple) -> object:
        """What the named function or class would return, or a stub if the result still needs its state."""
        if name in _NEW and args and isinstance(args[0], _Name):
            name, args = args[0].name, ()
        if name in _DICTS:
            # the first argument of a defaultdict is its factory
            pairs = next((part for part in args if not isinstance(part, _Name)), ())
            pairs = pairs.items() if type(pairs) is dict else pairs
            result: Any = self.dict_of([part for key, value in pairs for part in (key, value)])
        elif name in _ITEMS:
            (items,) = args or [()]
            result = _ITEMS[name](self.keys(items) if "set" in name else items)
        elif name in _CALLS:
            result = _CALLS[name](*args)
        elif name in _CLASSES:
            raise TypeError(f"a call of {name}")
        else:
            return _Stub(name, args)
        return self.within_budget(result)

    def set_state(self) -> None:
        """Replaces the stub on the stack with the value that its state describes."""
        state, stub = self.stack.pop(), self.stack[-1]
        if type(stub) is not _Stub or stub.value is not None:
            raise TypeError(f"a state of a {type(stub).__name__}")
        if stub.name == "numpy.dtype":
            value: Any = _dtype(stub.args[0], state[1])
        elif stub.name == _RECONSTRUCT:
            _, shape, dtype, is_fortran, data = state
            value = self.within_budget(_array(data, dtype, shape, is_fortran))
        elif stub.name.startswith("chumpy."):
            value = self.within_budget(_chumpy(stub.name, state))
        else:
            value = _dense(stub.name, state, self.dense_left)
            # the entries count as well, since many of them may be added into one number
            self.dense_left -= value.size + state["data"].size
        self.stack[-1] = value
        object.__setattr__(stub, "value", value)

    def within_budget(self, value: Any) -> Any:
        """Returns the value; raises FormatError if all values together exceed the limit for the file's size."""
        self.copies_left -= getattr(value, "nbytes", None) or (len(value) if hasattr(value, "__len__") else 0)
        if self.copies_left < 0:
            raise FormatError(f"has arrays larger than {_COPIES} times the file: get it as npz")
        return value

    def dict_of(self, items: list) -> dict:
        """A dict from a list of alternating keys and values."""
        return dict(zip(self.keys(items[::2]), items[1::2], strict=True))

    def fill(self, kind: type[set] | type[dict], items: Any) -> None:
        """Adds items to the set or dict on the stack."""
        target: Any = self.stack[-1]
        if type(target) is not kind:
            raise TypeError(f"items of a {type(target).__name__}")
        target.update(items)

    def make_dict(self) -> None:
        items = self.pop_mark()
        self.append(self.dict_of(items))

    def make_frozenset(self) -> None:
        items = self.pop_mark()
        self.append(frozenset(self.keys(items)))

    def keys(self, items: Iterable[Any]) -> Iterable[Any]:
        """Returns the items after checking that each is a safe key: a nested key could overflow the interpreter's
        stack, and numbers can be chosen to have the same hash, which takes quadratic time."""
        for item in items:
            if type(item) is str and item:
                continue
            parts = item if type(item) is tuple else (item,)
            if len(parts) > MAX_KEY_PARTS:
                raise TypeError(f"a tuple of {len(parts)} as a key")
            for part in parts:
                if type(part) not in _PLAIN and not isinstance(part, np.generic):
                    raise TypeError(f"a {type(item).__name__} as a key")
                if type(part) is int and abs(part) >= 2**63:
                    raise TypeError("a number of more than 64 bits as a key")
            # text is hashed with a secret seed, and so are tuples with text, but tuples that differ only in their
            # numbers can have the same hash
            has_text = any(isinstance(part, str | bytes) and part for part in parts)
            if has_text and (parts is not item or self.tuples.setdefault(hash(item), item) == item):
                continue
            self.key_share += 1 / (MAX_TUPLE_KEYS if parts is item else MAX_NUMBER_KEYS)
            if self.key_share > 1:
                raise FormatError(
                    f"has over {MAX_NUMBER_KEYS} numbers or {MAX_TUPLE_KEYS} tuples as keys: get it as npz"
                )
        return items


_DataUnpickler.dispatch |= {
    pickle.NEWOBJ[0]: pickle._Unpickler.dispatch[pickle.REDUCE[0]],
    pickle.BUILD[0]: _DataUnpickler.set_state,
    pickle.DICT[0]: _DataUnpickler.make_dict,
    pickle.FROZENSET[0]: _DataUnpickler.make_frozenset,
    pickle.ADDITEMS[0]: lambda self: self.fill(set, self.keys(self.pop_mark())),
    pickle.SETITEM[0]: lambda self: self.fill(dict, self.dict_of([self.stack.pop(-2), self.stack.pop()])),
    pickle.SETITEMS[0]: lambda self: self.fill(dict, self.dict_of(self.pop_mark())),
    # Python's own instruction allocates the announced size before it reads
    pickle.BYTEARRAY8[0]: pickle._Unpickler.dispatch[pickle.BINBYTES8[0]],
}


def _check_levels(value: Any, levels: dict[int, int | None], depth: int = 0) -> int:
    """The number of container levels of a value. levels: those of the values seen before by id, None during counting.

    Raises FormatError for too many levels, a container that contains itself, and an object that never got its state.
    """
    if type(value) is _Stub and not value.name.startswith("chumpy."):
        raise FormatError(f"has a {value.name} without content: {_REMEDY}")
    parts: Iterable[Any] = ()
    if type(value) in _CONTAINERS:
        # keys are skipped: `keys` allows only plain values and flat tuples
        parts = value.values() if isinstance(value, dict) else value
    elif isinstance(value, np.ndarray) and value.dtype.kind == "O":
        parts = value.flat
    if id(value) not in levels:
        levels[id(value)] = None
        children = (part for part in parts if type(part) not in _PLAIN and (type(part) not in _CONTAINERS or part))
        child_levels = (_check_levels(part, levels, depth + 1) for part in children) if depth < MAX_DEPTH else ()
        levels[id(value)] = 1 + max(child_levels, default=0)
    count = levels[id(value)]
    if count is None:
        raise FormatError("holds a list or dict that contains itself: get it as npz")
    if depth + count > MAX_DEPTH:
        raise FormatError(f"is nested more than {MAX_DEPTH} levels deep: get it as npz")
    return count


# maps module names of Python 2 and of numpy 2 to those of Python 3 and of older numpy versions
_MODULES = {
    "__builtin__": "builtins",
    "copy_reg": "copyreg",
    "numpy._core.multiarray": "numpy.core.multiarray",
    "numpy._core.numeric": "numpy.core.numeric",
}
_NEW = ("copyreg._reconstructor", "copyreg.__newobj__")
_DICTS = ("collections.OrderedDict", "collections.defaultdict", "builtins.dict")
_ITEMS = {f"builtins.{kind.__name__}": kind for kind in (list, tuple, set, frozenset)}
_RECONSTRUCT = "numpy.core.multiarray._reconstruct"
_SPARSE = re.compile(r"scipy\.sparse\.([a-z_]+\.)?(csc|csr)_(matrix|array)")
_DTYPE = re.compile(r"[|<>=]?(b1|[iu][1248]|f(2|4|8|16)|c(8|16|32)|[SU][1-9]\d{0,8}|O\d*|\?)")


# --- numpy and Python's own


def _dtype(code: object, order: object) -> np.dtype:
    if not isinstance(code, str) or not _DTYPE.fullmatch(code):
        raise FormatError(f"has arrays of type {shorten(repr(code))}, expected numbers or text: get it as npz")
    if "O" in code:
        return np.dtype(object)
    return np.dtype((order if order in ("<", ">", "|", "=") else "") + code.lstrip("|<>="))


def _array(data: Any, dtype: object, shape: object, order: object = "C") -> np.ndarray:
    """order: "C", "F", or a boolean that is true for Fortran order."""
    if not isinstance(dtype, np.dtype) or not isinstance(shape, tuple) or any(type(n) is not int for n in shape):
        raise FormatError(f"has an array without type or shape: {_REMEDY}")
    layout: Literal["C", "F"] = "F" if order in ("F", True) else "C"
    # Python 2 stored the content as text
    data = data.encode("latin1") if isinstance(data, str) else data
    is_object = dtype.kind == "O"
    expected: Any = list if is_object else bytes
    if not isinstance(data, expected):
        raise FormatError(f"has an array of a {type(data).__name__}: {_REMEDY}")
    # the product of thousands of numbers would take too long
    if len(shape) > 64 or len(data) != math.prod(shape) * (1 if is_object else dtype.itemsize):
        actual = f"{shorten(str(shape[:64]))} with {len(data)} {'items' if is_object else 'bytes'}"
        raise FormatError(f"has an array of the shape {actual}: {_REMEDY}")
    if not is_object:
        return np.ndarray(shape, dtype, data, order=layout).copy(layout)
    flat = np.empty(len(data), dtype)
    for i, item in enumerate(data):
        flat[i] = item
    return flat.reshape(shape, order=layout)


def _encode(text: object = b"", encoding: object = "latin1") -> bytes:
    """Restores bytes that Python 3 pickled for Python 2 as text and its encoding."""
    if isinstance(text, bytes):
        return text
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise FormatError(f"makes bytes from something other than latin-1 text: {_REMEDY}")
    return text.encode("latin1")


# callables whose result needs no state
_CALLS: dict[str, Callable[..., object]] = {
    "numpy.core.multiarray.scalar": lambda dtype, data: _array(data, dtype, ())[()],
    "numpy.core.numeric._frombuffer": _array,
    "_codecs.encode": _encode,
    "builtins.bytes": _encode,
    "builtins.bytearray": _encode,
    # arithmetic instead of complex() on the arguments rejects text: the same long text could be parsed again and again
    "builtins.complex": lambda real, imaginary: complex(1.0 * real, 1.0 * imaginary),
}
# names that may be referenced but not called
_CLASSES = ("numpy.ndarray", "builtins.object", *_NEW)
_KNOWN = {"numpy.dtype", _RECONSTRUCT, *_CLASSES, *_DICTS, *_ITEMS, *_CALLS}


# --- chumpy and scipy


def _chumpy(name: str, state: Any) -> np.ndarray | Unread:
    """The numbers of a chumpy object: a Ch stores them as `x`; a Select picks entries of an array by flat indices."""
    source, indices = state.get("a"), state.get("idxs")
    if name == "chumpy.reordering.Select" and isinstance(source, np.ndarray) and isinstance(indices, np.ndarray):
        selection = source.flat[indices.astype(np.int64)]
        shape = state.get("preferred_shape")
        return selection if shape is None else selection.reshape(shape)
    return state["x"] if isinstance(state.get("x"), np.ndarray) else Unread(name)


def _dense(name: str, state: Any, max_numbers: int) -> np.ndarray:
    """A sparse matrix of at most `max_numbers` values as dense: indptr (lines + 1,), indices and data (entries,)."""
    try:
        rows, columns = map(operator.index, state.get("_shape", state.get("shape")))
        starts, indices, data = (state[part] for part in ("indptr", "indices", "data"))
        if rows * columns > max_numbers:
            actual = f"{rows} x {columns}; up to {MAX_DENSE} numbers are read in total"
            raise FormatError(f"has a {name} of {actual}: get it as npz")
        matrix = np.zeros((columns, rows) if "csc" in name else (rows, columns), data.dtype)
        counts = np.diff(starts.astype(np.int64))
        is_consistent = starts[0] == 0 and indices.shape == data.shape == (starts[-1],) and (counts >= 0).all()
        if not is_consistent or (indices < 0).any() or data.dtype.kind not in "fiub":
            raise ValueError
        np.add.at(matrix, (np.repeat(np.arange(len(matrix)), counts), indices), data)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError):
        raise FormatError(f"has a {name} whose parts do not fit together: {_REMEDY}") from None
    return matrix.T.copy() if "csc" in name else matrix
