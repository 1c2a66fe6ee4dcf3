"""pickle's stack machine, without objects: what a pickle would import or call is only written down.

A pickle is a program that can call anything. Here its calls become `Call`s, its classes and functions `Named`s, and
nothing of them is imported or run; `pickles` says what the few that are data mean.

Source: the opcodes of protocols 0 to 5 as CPython's `pickletools` documents them.
"""

import pickle
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass, field

from lidarpose.io.headers import Problem, shorten


@dataclass(frozen=True)
class Named:
    """A class or function, by its name "module.name"."""

    name: str


@dataclass(eq=False)
class Call:
    """What would be made by calling `what` with `args`, given `state`, and filled with `items` (of a list or a set)
    and `pairs` (of a dict)."""

    what: Named
    args: tuple
    state: object = None
    items: list = field(default_factory=list)
    pairs: list = field(default_factory=list)


# values without parts
PLAIN = frozenset({type(None), bool, int, float, str, bytes})
_BROKEN = "is damaged or no pickle"
_REMEDY = "copy it again, or ask for npz"


def run(data: bytes, allowed: Callable[[str], bool]) -> object:
    """What the pickle `data` puts together, of lists, tuples, dicts, sets, plain values, `Named` and `Call`.

    allowed: "module.name" -> whether it may be named. Raises Problem for a name that may not, for what only a
    running Python could resolve, and for a damaged pickle.
    """
    machine = _Machine(data, allowed)
    try:
        return machine.run()
    except (ValueError, TypeError, IndexError, KeyError, OverflowError, struct.error) as error:
        raise Problem(f"{_BROKEN} ({shorten(str(error)) or type(error).__name__}): {_REMEDY}") from None


class _Machine:
    def __init__(self, data: bytes, allowed: Callable[[str], bool]):
        self.data, self.at, self.allowed = data, 0, allowed
        self.stack: list = []
        # the stacks below the marks
        self.below: list[list] = []
        self.memo: dict[int, object] = {}

    def run(self) -> object:
        values, actions, data = _VALUES, _ACTIONS, self.data
        while True:
            if self.at >= len(data):
                raise Problem(f"is cut off: the pickle has no end; {_REMEDY}")
            code = data[self.at]
            self.at += 1
            if code in values:
                # made first: it may exchange the stack
                value = values[code](self)
                self.stack.append(value)
            elif code in actions:
                actions[code](self)
            elif code == pickle.STOP[0]:
                return self.stack.pop()
            elif code in _ELSEWHERE:
                raise Problem(f"its pickle wants {_ELSEWHERE[code]}, which only its maker has: ask for npz")
            else:
                raise Problem(f"{_BROKEN} (no instruction {code:#04x} at byte {self.at - 1}): {_REMEDY}")

    # --- arguments

    def take(self, count: int) -> bytes:
        if not 0 <= count <= len(self.data) - self.at:
            raise Problem(f"is cut off: {count} bytes are announced at byte {self.at}, fewer follow; {_REMEDY}")
        self.at += count
        return self.data[self.at - count : self.at]

    def number(self, form: str):
        return struct.unpack(form, self.take(struct.calcsize(form)))[0]

    def counted(self, form: str) -> bytes:
        return self.take(self.number(form))

    def line(self) -> bytes:
        end = self.data.find(b"\n", self.at)
        if end < 0:
            raise Problem(f"is cut off: a line at byte {self.at} does not end; {_REMEDY}")
        text = self.data[self.at : end]
        self.at = end + 1
        return text

    def marked(self) -> list:
        items, self.stack = self.stack, self.below.pop()
        return items

    def last(self, count: int) -> tuple:
        if len(self.stack) < count:
            raise IndexError("too few values")
        items = tuple(self.stack[-count:])
        del self.stack[-count:]
        return items

    # --- names and calls

    def named(self, module: object, name: object) -> Named:
        if not isinstance(module, str) or not isinstance(name, str):
            raise TypeError("a name that is no text")
        full = f"{module}.{name}"
        if not self.allowed(full):
            raise Problem(
                f"its pickle wants {shorten(full)}, which is not on the list of plain data (arrays, lists, dicts, "
                "chumpy, scipy.sparse): nothing was run; ask for npz"
            )
        return Named(full)

    def call(self, what: object, args: object) -> Call:
        if not isinstance(what, Named) or not isinstance(args, tuple | list):
            raise TypeError("a call of something that is no name")
        return Call(what, tuple(args))

    def instance(self) -> Call:
        what, *args = self.marked()
        return self.call(what, args)

    def instance_with_names(self) -> Call:
        what, args, named = self.last(3)
        if named:
            raise TypeError("a call with named arguments")
        return self.call(what, args)

    # --- what changes what is on the stack

    def remember(self, key: int):
        self.memo[key] = self.stack[-1]

    def mark(self):
        self.below.append(self.stack)
        self.stack = []

    def pop(self):
        if self.stack:
            self.stack.pop()
        else:
            self.marked()

    def extend(self, items: list):
        target = self.stack[-1]
        if type(target) is list:
            target.extend(items)
        elif isinstance(target, Call):
            target.items.extend(items)
        else:
            raise TypeError(f"items of a {type(target).__name__}")

    def add(self, items: list):
        target = self.stack[-1]
        if type(target) is set:
            target.update(keys(items))
        else:
            self.extend(items)

    def update(self, items: list):
        if len(items) % 2:
            raise ValueError("a key without a value")
        target, pairs = self.stack[-1], zip(keys(items[::2]), items[1::2], strict=True)
        if type(target) is dict:
            target.update(pairs)
        elif isinstance(target, Call):
            target.pairs.extend(pairs)
        else:
            raise TypeError(f"values by key of a {type(target).__name__}")

    def build(self):
        state = self.stack.pop()
        target = self.stack[-1]
        if not isinstance(target, Call):
            raise TypeError(f"a state of a {type(target).__name__}")
        target.state = state


def keys(items: list) -> list:
    """The items, once each is one that can be a key: a nested one could overflow the interpreter's own stack."""
    for item in items:
        parts = item if type(item) is tuple else (item,)
        if not all(type(part) in PLAIN or isinstance(part, Call | Named) for part in parts):
            raise TypeError(f"a {type(item).__name__} as a key")
        # larger ones can be made to share one hash, and to take for ever
        if any(type(part) is int and abs(part) >= 2**63 for part in parts):
            raise TypeError("a number of more than 64 bits as a key")
    return items


def _text_number(text: bytes) -> int | bool:
    if text in (b"00", b"01"):
        return text == b"01"
    return int(text.removesuffix(b"L"))


_ESCAPES = {b"\\": b"\\", b"'": b"'", b'"': b'"', b"n": b"\n", b"r": b"\r", b"t": b"\t"}


def _quoted(text: bytes) -> str:
    """Python 2's repr of a string."""
    if len(text) < 2 or text[:1] != text[-1:] or text[:1] not in b"'\"":
        raise ValueError("a string without quotes")

    def plain(match: re.Match) -> bytes:
        found = match[1]
        return _ESCAPES[found] if found in _ESCAPES else bytes([int(found[1:], 16)])

    return re.sub(rb"\\(x[0-9a-fA-F]{2}|[\\'\"nrt])", plain, text[1:-1]).decode("latin1")


def _utf8(text: bytes) -> str:
    return text.decode("utf-8", "surrogatepass")


def _signed(data: bytes) -> int:
    return int.from_bytes(data, "little", signed=True)


# what puts a value on the stack
_VALUES = {
    code[0]: make
    for code, make in {
        pickle.NONE: lambda m: None,
        pickle.NEWTRUE: lambda m: True,
        pickle.NEWFALSE: lambda m: False,
        pickle.INT: lambda m: _text_number(m.line()),
        pickle.LONG: lambda m: _text_number(m.line()),
        pickle.BININT: lambda m: m.number("<i"),
        pickle.BININT1: lambda m: m.number("<B"),
        pickle.BININT2: lambda m: m.number("<H"),
        pickle.LONG1: lambda m: _signed(m.counted("<B")),
        pickle.LONG4: lambda m: _signed(m.counted("<i")),
        pickle.FLOAT: lambda m: float(m.line()),
        pickle.BINFLOAT: lambda m: m.number(">d"),
        pickle.STRING: lambda m: _quoted(m.line()),
        pickle.BINSTRING: lambda m: m.counted("<i").decode("latin1"),
        pickle.SHORT_BINSTRING: lambda m: m.counted("<B").decode("latin1"),
        pickle.UNICODE: lambda m: m.line().decode("raw-unicode-escape"),
        pickle.BINUNICODE: lambda m: _utf8(m.counted("<I")),
        pickle.SHORT_BINUNICODE: lambda m: _utf8(m.counted("<B")),
        pickle.BINUNICODE8: lambda m: _utf8(m.counted("<Q")),
        pickle.BINBYTES: lambda m: m.counted("<I"),
        pickle.SHORT_BINBYTES: lambda m: m.counted("<B"),
        pickle.BINBYTES8: lambda m: m.counted("<Q"),
        pickle.BYTEARRAY8: lambda m: m.counted("<Q"),
        pickle.EMPTY_LIST: lambda m: [],
        pickle.EMPTY_DICT: lambda m: {},
        pickle.EMPTY_TUPLE: lambda m: (),
        pickle.EMPTY_SET: lambda m: set(),
        pickle.LIST: lambda m: m.marked(),
        pickle.TUPLE: lambda m: tuple(m.marked()),
        pickle.FROZENSET: lambda m: frozenset(keys(m.marked())),
        pickle.TUPLE1: lambda m: m.last(1),
        pickle.TUPLE2: lambda m: m.last(2),
        pickle.TUPLE3: lambda m: m.last(3),
        pickle.DUP: lambda m: m.stack[-1],
        pickle.GET: lambda m: m.memo[int(m.line())],
        pickle.BINGET: lambda m: m.memo[m.number("<B")],
        pickle.LONG_BINGET: lambda m: m.memo[m.number("<I")],
        pickle.GLOBAL: lambda m: m.named(_utf8(m.line()), _utf8(m.line())),
        pickle.STACK_GLOBAL: lambda m: m.named(*m.last(2)),
        pickle.REDUCE: lambda m: m.call(*m.last(2)),
        pickle.NEWOBJ: lambda m: m.call(*m.last(2)),
        pickle.NEWOBJ_EX: lambda m: m.instance_with_names(),
        pickle.OBJ: lambda m: m.instance(),
        pickle.INST: lambda m: m.call(m.named(_utf8(m.line()), _utf8(m.line())), m.marked()),
    }.items()
}


def _dict(m: _Machine) -> dict:
    items = m.marked()
    m.stack.append({})
    m.update(items)
    return m.stack.pop()


_VALUES[pickle.DICT[0]] = _dict
_ACTIONS = {
    code[0]: act
    for code, act in {
        pickle.PROTO: lambda m: m.take(1),
        pickle.FRAME: lambda m: m.take(8),
        pickle.MARK: lambda m: m.mark(),
        pickle.POP: lambda m: m.pop(),
        pickle.POP_MARK: lambda m: m.marked(),
        pickle.PUT: lambda m: m.remember(int(m.line())),
        pickle.BINPUT: lambda m: m.remember(m.number("<B")),
        pickle.LONG_BINPUT: lambda m: m.remember(m.number("<I")),
        pickle.MEMOIZE: lambda m: m.remember(len(m.memo)),
        pickle.APPEND: lambda m: m.extend([m.stack.pop()]),
        pickle.APPENDS: lambda m: m.extend(m.marked()),
        pickle.ADDITEMS: lambda m: m.add(m.marked()),
        pickle.SETITEM: lambda m: m.update(list(m.last(2))),
        pickle.SETITEMS: lambda m: m.update(m.marked()),
        pickle.BUILD: lambda m: m.build(),
    }.items()
}
_ELSEWHERE = {
    code[0]: what
    for what, codes in {
        "an object by a persistent id": (pickle.PERSID, pickle.BINPERSID),
        "a class by a registered number": (pickle.EXT1, pickle.EXT2, pickle.EXT4),
        "a buffer outside of the file": (pickle.NEXT_BUFFER, pickle.READONLY_BUFFER),
    }.items()
    for code in codes
}
