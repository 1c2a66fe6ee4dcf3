"""Reading pickles of data without running them: SMPL's `.pkl`, SLOPER4D's and Human-M3's labels.

A pickle may call any function of the machine it is read on. Here Python's own unpickler gets a mark, `Unread`, for
every name on a list and an error for every other one. What a call of such a name means is decided below, so nothing
of the file is ever imported or called. Memory and time stay in proportion to the size of the file.
"""

import io
import math
import os
import pickle
import re
import struct
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from lidarpose.io.files import FormatError, file_error, read_bytes, shorten

# larger files do not hold labels or a body; they would be in memory three times
MAX_BYTES = 4 * 2**30
# how deep lists and dicts may be nested (chosen: data sets have less than ten levels)
MAX_DEPTH = 100
# sparse matrices become dense ones, together of at most so many numbers: SMPL-X's largest has 0.6 million
MAX_DENSE = 20_000_000
# keys without text have hashes that a file can make equal: so many cost a second at most, whatever they are
MAX_NUMBER_KEYS, MAX_TUPLE_KEYS = 20_000, 1_000
# a tuple is hashed whenever it is looked up
MAX_KEY_PARTS = 16
# instructions that a file of no size may have, and bytes for each further one; one can take 0.2 kB of memory
_STEPS, _BYTES_PER_STEP = 1_000_000, 2
# arrays and lists are copied out of the file, some of them twice or three times: Python 2 kept them as text
_FREE_COPIES, _COPIES = 4096, 8

_TEXT = (str, bytes)
# values without parts
_PLAIN = frozenset({type(None), bool, int, float, complex, str, bytes})
_CONTAINERS = (list, tuple, set, frozenset, dict)
_REMEDY = "copy it again, or ask for npz"


@dataclass(frozen=True)
class Unread:
    """Stands for a class or function "module.name", or for an object of it that holds no numbers which can be read."""

    name: str


def load_pickle(path: str | os.PathLike) -> Any:
    """The data of a pickle: dicts, lists, tuples, sets, numbers, text, bytes and numpy arrays.

    chumpy's arrays and scipy's csc and csr matrices come as (dense) arrays, strings of Python 2 as latin-1 text,
    OrderedDict and defaultdict as dict, an expression of chumpy as `Unread`.

    Raises InputError, on one line: a file that is missing, empty, cut off, damaged or over 4 GiB; a class or function
    that is not on the list, by its name; data that contains itself, or that grows far beyond the file's size.
    """
    size = 0
    with suppress(OSError, TypeError, ValueError):
        size = os.path.getsize(path)
    if size > MAX_BYTES:
        raise file_error(
            path, f"has {size / 2**30:.1f} GiB, {MAX_BYTES / 2**30:g} GiB are read at most: split it first"
        )
    data = read_bytes(path, expected="a pickle")
    if data.startswith(b"PK\x03\x04"):
        raise file_error(path, "expected a pickle, got a zip archive: an npz, if so name it .npz")
    try:
        content = _DataUnpickler(data).load()
        _check_levels(content, {}, 0)
        return content
    except FormatError as problem:
        raise file_error(path, problem) from None
    except MemoryError:
        raise file_error(path, "does not fit in memory: ask for npz, or split it") from None
    except (EOFError, struct.error):
        raise file_error(path, f"is cut off: the pickle has no end; {_REMEDY}") from None
    # a damaged file can make the unpickler and numpy raise anything
    except Exception as error:
        reason = shorten(str(error)) or type(error).__name__
        raise file_error(path, f"is damaged or no pickle ({reason}): {_REMEDY}") from None


class _Stub(Unread):
    """What a call made that still lacks its state; `value` is set with the state."""

    def __init__(self, name: str, args: tuple | list):
        super().__init__(name)
        self.args = args
        self.value: Any = None


class _Memo(dict):
    """The unpickler's memo, in which what has got its state is the value that it became.

    Picklers number what they remember from 0 or 1 on; numbers of a file's own choice could share one hash.
    """

    far = 0

    def __setitem__(self, key: int, value: object) -> None:
        if key >= 2**32:
            raise TypeError("a number of more than 32 bits in the memo")
        self.far += key > 2 * len(self) + 1000
        if self.far > MAX_NUMBER_KEYS:
            raise FormatError("numbers its parts in no order: ask for npz")
        super().__setitem__(key, value)

    def __getitem__(self, key: int) -> object:
        value = super().__getitem__(key)
        return value.value if type(value) is _Stub and value.value is not None else value


class _DataUnpickler(pickle._Unpickler):
    """Python's unpickler, in which every instruction that touches an object is replaced by one that knows plain data.

    The pure Python class, since it takes no memory for announced sizes and lets instructions be replaced.
    """

    dispatch: ClassVar[dict[int, Any]] = dict(pickle._Unpickler.dispatch)
    # Python's own, which its type stubs leave out
    pop_mark: Callable[[], list]
    stack: list[Any]

    def __init__(self, data: bytes):
        self.file = io.BytesIO(data)
        super().__init__(self.file, encoding="latin1")
        self.memo = _Memo()
        self.steps = _STEPS + len(data) // _BYTES_PER_STEP
        self.copies_left = _FREE_COPIES + _COPIES * len(data)
        self.dense_left = MAX_DENSE
        self.key_share = 0.0
        # tuples as keys, one of each hash
        self.tuples: dict[int, tuple] = {}

    def load(self) -> object:
        """The data. Raises EOFError where the file ends before it, and FormatError."""
        read = self.read = self.file.read
        self.readline = self.file.readline
        self.metastack: list[list] = []
        self.stack = []
        self.append = self.stack.append
        for _ in range(self.steps):
            code = read(1)
            if not code:
                raise EOFError
            if code == pickle.STOP:
                return self.stack.pop()
            self.dispatch[code[0]](self)
        raise FormatError("is a pickle of too many small parts for its size: ask for npz, or split it")

    def find_class(self, module: str, name: str) -> Unread:
        name = _canonical(f"{module}.{name}")
        if name not in _KNOWN and not name.startswith("chumpy.") and not _SPARSE.fullmatch(name):
            raise FormatError(
                f"its pickle wants {shorten(name)}, which is not on the list of plain data (arrays, lists, dicts, "
                "chumpy, scipy.sparse): nothing was run; ask for npz"
            )
        return Unread(name)

    def _instantiate(self, klass: object, args: list) -> None:
        """Of the instructions INST and OBJ."""
        self.append(self.call(klass, args))

    def load_call(self) -> None:
        args = self.stack.pop()
        self.append(self.call(self.stack.pop(), args))

    def load_call_with_names(self) -> None:
        if self.stack.pop():
            raise TypeError("a call with named arguments")
        self.load_call()

    def load_state(self) -> None:
        state, stub = self.stack.pop(), self.stack[-1]
        if type(stub) is not _Stub or stub.value is not None:
            raise TypeError(f"a state of a {type(stub).__name__}")
        stub.value = self.stack[-1] = self.build(stub.name, stub.args, state)

    def load_dict(self) -> None:
        items = self.pop_mark()
        self.append({})
        self.update(items)

    def load_frozenset(self) -> None:
        items = self.pop_mark()
        self.append(frozenset(self.keys(items)))

    def call(self, what: object, args: Any) -> object:
        """What `what(*args)` would return, or a stub where that lacks its state."""
        if type(what) is not Unread or not isinstance(args, tuple | list):
            raise TypeError("a call of something that is no name")
        name = what.name
        if name in _NEW and args and type(args[0]) is Unread:
            name, args = args[0].name, ()
        if name in _DICTS:
            pairs: Any = args[name == "collections.defaultdict" :] or [()]
            pairs = pairs[0].items() if isinstance(pairs[0], dict) else pairs[0]
            made: Any = dict(zip(self.keys([key for key, _ in pairs]), [value for _, value in pairs], strict=True))
        elif name in _ITEMS:
            (items,) = args or [()]
            if not isinstance(items, list | tuple | set | frozenset):
                raise TypeError(f"a {name} of something else than items")
            made = _ITEMS[name](self.keys(items) if "set" in name else items)
        elif name in _CALLS:
            made = _CALLS[name](*args)
        elif name in _CLASSES:
            raise TypeError(f"a call of {name}")
        else:
            return _Stub(name, args)
        return self.charged(made)

    def build(self, name: str, args: tuple | list, state: Any) -> object:
        """What a stub becomes with its state."""
        if name == "numpy.dtype":
            return _dtype(args, state)
        if name == _RECONSTRUCT:
            if not args or args[0] != Unread("numpy.ndarray") or not isinstance(state, tuple) or len(state) != 5:
                raise FormatError(f"has an array of an unknown class or without content: {_REMEDY}")
            _, shape, dtype, fortran, data = state
            return self.charged(_array(data, dtype, shape, "F" if fortran else "C"))
        if name.startswith("chumpy."):
            return self.charged(_chumpy(name, state))
        dense = _dense(name, state, self.dense_left)
        # many entries may add up in one number
        self.dense_left -= dense.size + state["data"].size
        return dense

    def charged(self, made: object) -> object:
        """The value, once it is sure that all values together do not outgrow the file."""
        self.copies_left -= getattr(made, "nbytes", None) or (len(made) if hasattr(made, "__len__") else 0)
        if self.copies_left < 0:
            raise FormatError(f"has arrays of more than {_COPIES} times its size: ask for npz")
        return made

    def extend(self, items: list) -> None:
        if type(self.stack[-1]) is not list:
            raise TypeError(f"items of a {type(self.stack[-1]).__name__}")
        self.stack[-1].extend(items)

    def add(self, items: list) -> None:
        if type(self.stack[-1]) is not set:
            raise TypeError(f"items of a {type(self.stack[-1]).__name__}")
        self.stack[-1].update(self.keys(items))

    def update(self, items: list) -> None:
        if type(self.stack[-1]) is not dict:
            raise TypeError(f"values by key of a {type(self.stack[-1]).__name__}")
        self.stack[-1].update(zip(self.keys(items[::2]), items[1::2], strict=True))

    def keys(self, items: Iterable[Any]) -> Iterable[Any]:
        """The items, once each can be a key: a nested one could overflow the interpreter's stack, and numbers can be
        made to share one hash, which takes time by the square of their count."""
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
            # text is hashed with a secret, and so are tuples with text, but those that differ in numbers alone can
            # share one hash
            if any(isinstance(part, _TEXT) and part for part in parts):
                charged = type(item) is tuple and self.tuples.setdefault(hash(item), item) != item
            else:
                charged = True
            if charged:
                self.key_share += 1 / (MAX_TUPLE_KEYS if type(item) is tuple else MAX_NUMBER_KEYS)
                if self.key_share > 1:
                    raise FormatError(
                        f"has over {MAX_NUMBER_KEYS} numbers or {MAX_TUPLE_KEYS} tuples as keys: ask for npz"
                    )
        return items


def _refuse(what: str) -> Callable[[_DataUnpickler], None]:
    def handler(self: _DataUnpickler) -> None:
        raise FormatError(f"its pickle wants {what}, which only its maker has: ask for npz")

    return handler


_HANDLERS = {
    # frames only say how much to read ahead
    pickle.FRAME: lambda self: self.read(8),
    **dict.fromkeys((pickle.PERSID, pickle.BINPERSID), _refuse("an object by a persistent id")),
    **dict.fromkeys((pickle.EXT1, pickle.EXT2, pickle.EXT4), _refuse("a class by a registered number")),
    **dict.fromkeys((pickle.NEXT_BUFFER, pickle.READONLY_BUFFER), _refuse("a buffer outside of the file")),
    **dict.fromkeys((pickle.REDUCE, pickle.NEWOBJ), _DataUnpickler.load_call),
    pickle.NEWOBJ_EX: _DataUnpickler.load_call_with_names,
    pickle.BUILD: _DataUnpickler.load_state,
    pickle.DICT: _DataUnpickler.load_dict,
    pickle.FROZENSET: _DataUnpickler.load_frozenset,
    pickle.APPEND: lambda self: self.extend([self.stack.pop()]),
    pickle.APPENDS: lambda self: self.extend(self.pop_mark()),
    pickle.ADDITEMS: lambda self: self.add(self.pop_mark()),
    pickle.SETITEM: lambda self: self.update([self.stack.pop(-2), self.stack.pop()]),
    pickle.SETITEMS: lambda self: self.update(self.pop_mark()),
    # Python's own takes the announced memory before it reads
    pickle.BYTEARRAY8: pickle._Unpickler.dispatch[pickle.BINBYTES8[0]],
}
_DataUnpickler.dispatch |= {code[0]: handler for code, handler in _HANDLERS.items()}


def _check_levels(value: Any, levels: dict[int, int | None], depth: int) -> int:
    """How many levels of containers a value has. levels: by id, of those seen before, None while they are counted.

    Raises FormatError for too many, for a container in itself, and for an object that never got its state.
    """
    if type(value) in _PLAIN:
        return 0
    if id(value) in levels:
        known = levels[id(value)]
        if known is None:
            raise FormatError("holds a list or dict that contains itself: ask for npz")
        return known
    if type(value) is _Stub:
        if not value.name.startswith("chumpy."):
            raise FormatError(f"has a {value.name} without content: {_REMEDY}")
        return 0
    parts: Iterable[Any] = ()
    if type(value) in _CONTAINERS:
        # keys have no parts that have parts
        parts = value.values() if isinstance(value, dict) else value
    elif isinstance(value, np.ndarray) and value.dtype.kind == "O":
        parts = value.flat
    levels[id(value)] = None
    inner = (part for part in parts if type(part) not in _PLAIN and (type(part) not in _CONTAINERS or part))
    count = (
        max((1 + _check_levels(part, levels, depth + 1) for part in inner), default=1) if depth < MAX_DEPTH else depth
    )
    if count > MAX_DEPTH:
        raise FormatError(f"is nested more than {MAX_DEPTH} levels deep: ask for npz")
    levels[id(value)] = count
    return count


_NEW = ("copyreg._reconstructor", "copyreg.__newobj__")
_DICTS = ("collections.OrderedDict", "collections.defaultdict", "builtins.dict")
_ITEMS = {f"builtins.{kind.__name__}": kind for kind in (list, tuple, set, frozenset)}
_RECONSTRUCT = "numpy.core.multiarray._reconstruct"
_SPARSE = re.compile(r"scipy\.sparse\.([a-z_]+\.)?(csc|csr)_(matrix|array)")


def _canonical(name: str) -> str:
    """Python 2's and numpy 2's names as those of Python 3 and of the older numpy."""
    for other, usual in (("__builtin__.", "builtins."), ("copy_reg.", "copyreg."), ("numpy._core.", "numpy.core.")):
        if name.startswith(other):
            return usual + name.removeprefix(other)
    return name


# --- numpy and Python's own


def _dtype(args: tuple | list, state: object) -> np.dtype:
    code = args[0] if args else None
    if not isinstance(code, str) or not re.fullmatch(
        r"[|<>=]?(b1|[iu][1248]|f(2|4|8|16)|c(8|16|32)|[SU]\d{1,9}|O\d*|\?)", code
    ):
        raise FormatError(f"has arrays of type {shorten(repr(code))}; numbers and text are read: ask for npz")
    if "O" in code:
        return np.dtype(object)
    if not isinstance(state, tuple) or len(state) < 5 or any(x is not None for x in state[2:5]):
        raise FormatError(f"has arrays of a type derived from {code}; plain numbers and text are read: ask for npz")
    order = state[1] if state[1] in ("<", ">", "|", "=") else ""
    return np.dtype(order + code.lstrip("|<>="))


def _array(data: Any, dtype: object, shape: object, order: Literal["C", "F"]) -> np.ndarray:
    if not isinstance(dtype, np.dtype) or not isinstance(shape, tuple) or any(type(n) is not int for n in shape):
        raise FormatError(f"has an array without type or shape: {_REMEDY}")
    # Python 2 kept the content as text
    data = data.encode("latin1") if isinstance(data, str) else data
    is_object = dtype.kind == "O"
    expected: Any = list if is_object else bytes
    if not isinstance(data, expected):
        raise FormatError(f"has an array of a {type(data).__name__}: {_REMEDY}")
    count = math.prod(shape)
    size = 1 if is_object else dtype.itemsize
    if any(n < 0 for n in shape) or len(data) != count * size or count and not size:
        came = f"{shorten(str(shape))} with {len(data)} {'items' if is_object else 'bytes'}"
        raise FormatError(f"has an array of the shape {came}: {_REMEDY}")
    if is_object or not data:
        flat = np.empty(count, dtype)
        for i, item in enumerate(data):
            flat[i] = item
    else:
        flat = np.frombuffer(data, dtype).copy()
    return flat.reshape(shape, order=order)


def _from_buffer(data: object, dtype: object, shape: object, order: object) -> np.ndarray:
    return _array(data, dtype, shape, "F" if order == "F" else "C")


def _scalar(dtype: object, data: object) -> Any:
    if not isinstance(dtype, np.dtype) or dtype.kind == "O":
        raise FormatError("has a number of type object: ask for npz")
    return _array(data, dtype, (), "C")[()]


def _encode(text: object = b"", encoding: object = "latin1") -> bytes:
    """How Python 3 writes bytes for Python 2: as text and its encoding."""
    if isinstance(text, bytes):
        return text
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise FormatError(f"makes bytes of something else than latin-1 text: {_REMEDY}")
    return text.encode("latin1")


# what can be made at once, without a state
_CALLS: dict[str, Callable[..., object]] = {
    "numpy.core.multiarray.scalar": _scalar,
    "numpy.core.numeric._frombuffer": _from_buffer,
    "_codecs.encode": _encode,
    "builtins.bytes": _encode,
    "builtins.bytearray": _encode,
    # no text: the same long one could be parsed again and again
    "builtins.complex": lambda real, imaginary: complex(1.0 * real, 1.0 * imaginary),
}
# what may be named, not called
_CLASSES = ("numpy.ndarray", "builtins.object", *_NEW)
_KNOWN = {"numpy.dtype", _RECONSTRUCT, *_CLASSES, *_DICTS, *_ITEMS, *_CALLS}


# --- chumpy and scipy


def _chumpy(name: str, state: object) -> np.ndarray | Unread:
    """A Ch holds its numbers as `x`; a Select is a choice from another, by flat indices."""
    if not isinstance(state, dict):
        return Unread(name)
    parts: list[Any] = [state.get(key) for key in ("a", "idxs")]
    if name == "chumpy.reordering.Select" and all(isinstance(part, np.ndarray) for part in parts):
        selected = parts[0].flat[parts[1].astype(np.int64)]
        shape = state.get("preferred_shape")
        return selected if shape is None else selected.reshape(shape)
    return state["x"] if isinstance(state.get("x"), np.ndarray) else Unread(name)


def _dense(name: str, state: object, most: int) -> np.ndarray:
    """A compressed sparse matrix, of at most so many numbers: indptr (lines + 1,), indices and data (entries,)."""
    state = state if isinstance(state, dict) else {}
    shape: Any = state.get("_shape", state.get("shape"))
    parts: list[Any] = [state.get(part) for part in ("indptr", "indices", "data")]
    good = isinstance(shape, tuple) and len(shape) == 2 and all(isinstance(n, int | np.integer) for n in shape)
    for part, kinds in zip(parts, ("iu", "iu", "fiub"), strict=True):
        good = good and isinstance(part, np.ndarray) and part.ndim == 1 and part.dtype.kind in kinds
    if not good:
        raise FormatError(f"has a {name} without its parts: {_REMEDY}")
    rows, columns = (int(n) for n in shape)
    if min(shape) < 0 or rows * columns > most:
        raise FormatError(f"has a {name} of {rows} x {columns}; up to {MAX_DENSE} numbers are read in all: ask for npz")
    lines, across = (columns, rows) if "csc" in name else (rows, columns)
    start, index, data = parts[0].astype(np.int64), parts[1].astype(np.int64), parts[2]
    counts = np.diff(start)
    fits = len(start) == lines + 1 and start[0] == 0 and start[-1] == len(data) == len(index) and (counts >= 0).all()
    if not fits or ((index < 0) | (index >= across)).any():
        raise FormatError(f"has a {name} whose parts do not fit together: {_REMEDY}")
    dense = np.zeros((lines, across), data.dtype)
    np.add.at(dense, (np.repeat(np.arange(lines), counts), index), data)
    return dense.T.copy() if "csc" in name else dense
