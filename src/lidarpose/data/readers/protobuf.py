"""Protocol buffer messages by the numbers of their fields: only what is asked for is decoded, the rest is stepped over.

A field is a varint `number << 3 | kind`, then by kind 0: a varint; 1: 8 bytes; 2: a varint length and so many bytes
(text, bytes, a message, or packed numbers); 5: 4 bytes. All is little-endian.
"""

import numpy as np

from lidarpose.errors import InputError

_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5
_SIZES = {_EIGHT: 8, _FOUR: 4}
_KINDS = {_VARINT: "a varint", _EIGHT: "8 bytes", _BYTES: "bytes", _FOUR: "4 bytes"}
_LONGEST = 10
# of a message: one of matrices has as many as they have numbers, where these are not packed; and packed integers
_MOST_FIELDS = 2_000_000


class Message:
    """One message. Where a field that is asked for singly is there several times, the last counts, as in protobuf.

    Raises InputError for a message that is cut off, and for a field of another kind than asked for.
    """

    def __init__(self, data: bytes | memoryview):
        self._fields: dict[int, list[tuple[int, int | memoryview]]] = {}
        data, at, count = memoryview(data), 0, 0
        while at < len(data):
            key, at = _varint(data, at)
            number, kind = key >> 3, key & 7
            value: int | memoryview
            if kind == _VARINT:
                value, at = _varint(data, at)
            elif kind in _KINDS:
                length, at = _varint(data, at) if kind == _BYTES else (_SIZES[kind], at)
                if at + length > len(data):
                    raise InputError(f"message is cut off in field {number}")
                value, at = data[at : at + length], at + length
            else:
                raise InputError(f"message has a field of unknown kind {kind}: damaged, or no protobuf")
            count += 1
            if count > _MOST_FIELDS:
                raise InputError(f"message has more than {_MOST_FIELDS:,} fields: damaged, or none of Waymo's")
            self._fields.setdefault(number, []).append((kind, value))

    def __contains__(self, number: int) -> bool:
        return number in self._fields

    def _all(self, number: int, *kinds: int) -> list[tuple[int, int | memoryview]]:
        found = self._fields.get(number, [])
        for kind, _ in found:
            if kind not in kinds:
                raise InputError(f"field {number} of a message is {_KINDS[kind]}, expected {_KINDS[kinds[0]]}")
        return found

    def _last(self, number: int, kind: int) -> int | memoryview | None:
        found = self._all(number, kind)
        return found[-1][1] if found else None

    def message(self, number: int) -> "Message | None":
        data = self._last(number, _BYTES)
        return None if data is None else Message(data)

    def messages(self, number: int) -> "list[Message]":
        return [Message(data) for _, data in self._all(number, _BYTES)]

    def data(self, number: int) -> memoryview | None:
        return self._last(number, _BYTES)

    def text(self, number: int) -> str | None:
        data = self._last(number, _BYTES)
        return None if data is None else bytes(data).decode("utf-8", "replace")

    def integer(self, number: int) -> int | None:
        """An int32, int64, bool or enum."""
        value = self._last(number, _VARINT)
        return None if value is None else _signed(value)

    def double(self, number: int) -> float | None:
        data = self._last(number, _EIGHT)
        return None if data is None else float(np.frombuffer(data, "<f8")[0])

    def doubles(self, number: int) -> np.ndarray:
        """(n,) float64 of a repeated double, packed or not."""
        return self._repeated(number, _EIGHT, "<f8")

    def floats(self, number: int) -> np.ndarray:
        """(n,) float32 of a repeated float, packed or not."""
        return self._repeated(number, _FOUR, "<f4")

    def integers(self, number: int) -> list[int]:
        """A repeated int32 or int64, packed or not."""
        found = []
        for kind, value in self._all(number, _VARINT, _BYTES):
            if kind == _VARINT:
                found.append(_signed(value))
                continue
            at = 0
            while at < len(value):
                one, at = _varint(value, at)
                found.append(_signed(one))
                if len(found) > _MOST_FIELDS:
                    raise InputError(f"field {number} of a message has more than {_MOST_FIELDS:,} integers: damaged")
        return found

    def _repeated(self, number: int, kind: int, dtype: str) -> np.ndarray:
        found = [value for _, value in self._all(number, kind, _BYTES)]
        if any(len(value) % _SIZES[kind] for value in found):
            raise InputError(f"field {number} of a message holds no whole number of {dtype[1:]}")
        return np.concatenate([np.frombuffer(value, dtype) for value in found] or [np.zeros(0, dtype)])


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    """(value, where the next begins): 7 bits a byte, the lowest first, the eighth tells that more follow."""
    value = 0
    for k, byte in enumerate(data[at : at + _LONGEST]):
        value |= (byte & 0x7F) << 7 * k
        if byte < 0x80:
            return value & 0xFFFFFFFFFFFFFFFF, at + k + 1
    raise InputError("message is cut off" if len(data) - at < _LONGEST else "message is damaged: a varint has no end")


def _signed(value: int) -> int:
    """A 64 bit number in two's complement."""
    return value - (1 << 64) if value >> 63 else value
