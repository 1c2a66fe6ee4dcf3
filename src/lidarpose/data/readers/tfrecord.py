"""TFRecord files: records one after the other, each with checksums.

    length          uint64, little-endian
    its checksum    uint32
    data            `length` bytes
    its checksum    uint32

A checksum is the CRC-32C (Castagnoli) of the bytes, turned right by 15 bits, plus a constant.
"""

from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np

from lidarpose.io.files import file_error

# Castagnoli's polynomial, bits reflected
_POLYNOMIAL = 0x82F63B78
_ALL = 0xFFFFFFFF
_MASK_ADDED = 0xA282EAD8
_HEAD, _TAIL = 12, 4
# bytes that one lane of the checksum goes through: lanes run side by side
_LANE = 1024
# byte by byte is faster below
_FEW = 512


def records(path: Path) -> Iterator[bytes]:
    """The records of a file, one in memory at a time. Raises InputError where one is cut off or damaged: what follows
    cannot be found, since only a record tells where the next begins."""
    try:
        size = path.stat().st_size
        with open(path, "rb") as file:
            number = 0
            while head := file.read(_HEAD):
                if len(head) < _HEAD:
                    raise file_error(path, f"is cut off in record {number}; copy it again")
                length = int.from_bytes(head[:8], "little")
                if masked_checksum(head[:8]) != int.from_bytes(head[8:], "little"):
                    what = "is no TFRecord file" if number == 0 else f"is damaged at record {number}"
                    raise file_error(path, f"{what} (the checksum of a length is wrong); copy it again")
                if file.tell() + length + _TAIL > size:
                    raise file_error(path, f"is cut off in record {number}; copy it again")
                data, tail = file.read(length), file.read(_TAIL)
                if masked_checksum(data) != int.from_bytes(tail, "little"):
                    raise file_error(path, f"is damaged in record {number} (its checksum is wrong); copy it again")
                yield data
                number += 1
    except OSError as error:
        raise file_error(path, f"cannot be read ({error.strerror or error}); check the path and its rights") from None


def masked_checksum(data: bytes) -> int:
    """What a TFRecord stores of some bytes."""
    crc = crc32c(data)
    return ((crc >> 15 | crc << 17) + _MASK_ADDED) & _ALL


def crc32c(data: bytes) -> int:
    """The CRC-32C of some bytes, about 100 MB a second.

    A CRC is linear: lanes of `_LANE` bytes are gone through side by side, each from zero, and put together two by two.
    Zeros before the first byte leave a state of zero as it is, so that lanes can be filled up in front; a CRC begins
    with all ones, which is the same as inverting the first four bytes.
    """
    if len(data) < _FEW:
        return _crc_of_few(data)
    lanes = -(-len(data) // _LANE)
    padded = np.zeros(lanes * _LANE, np.uint8)
    start = len(padded) - len(data)
    padded[start:] = np.frombuffer(data, np.uint8)
    padded[start : start + 4] ^= 0xFF
    low, high = _tables()
    state = np.zeros(lanes, np.uint32)
    for word in np.ascontiguousarray(padded.view("<u4").reshape(lanes, -1).T):
        state = state ^ word
        state = low[state & 0xFFFF] ^ high[state >> 16]
    distance = _LANE
    while len(state) > 1:
        if len(state) % 2:
            state = np.concatenate([np.zeros(1, np.uint32), state])
        state = _after_zeros(state[0::2], distance) ^ state[1::2]
        distance *= 2
    return int(state[0]) ^ _ALL


def _crc_of_few(data: bytes) -> int:
    state, table = _ALL, _byte_table()
    for byte in data:
        state = int(table[(state ^ byte) & 0xFF]) ^ state >> 8
    return state ^ _ALL


@cache
def _byte_table() -> np.ndarray:
    """(256,) uint32: the state after a byte, from zero."""
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, table >> 1 ^ np.uint32(_POLYNOMIAL), table >> 1)
    return table


@cache
def _tables() -> tuple[np.ndarray, np.ndarray]:
    """Two (65536,) uint32: what the lower and the upper half of a state become after four zero bytes."""
    half = np.arange(1 << 16, dtype=np.uint32)
    return _step(_step(_step(_step(half)))), _step(_step(_step(_step(half << 16))))


def _step(state: np.ndarray) -> np.ndarray:
    """States after a zero byte."""
    return _byte_table()[state & 0xFF] ^ state >> 8


@cache
def _zeros(count: int) -> tuple[int, ...]:
    """What each of a state's 32 bits becomes after so many zero bytes, a power of two of them."""
    bits = np.uint32(1) << np.arange(32, dtype=np.uint32)
    return tuple((_step(bits) if count == 1 else _after_zeros(bits, count // 2, twice=True)).tolist())


def _after_zeros(state: np.ndarray, count: int, *, twice: bool = False) -> np.ndarray:
    """States after so many zero bytes, a power of two of them, or twice as many."""
    found = np.zeros_like(state)
    for bit, becomes in enumerate(_zeros(count)):
        found ^= (state >> np.uint32(bit) & 1) * np.uint32(becomes)
    return _after_zeros(found, count) if twice else found
