"""What every reader of a dataset yields, and what it must offer.

A dataset's raw files fall into parts, each read on its own (a sequence, a segment, a file): that is what processes
share out, and what is written as one shard.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from lidarpose.sample import LabeledSample


@dataclass(frozen=True, kw_only=True)
class Skipped:
    """What was left out: reason, the same words for the same reason, and where."""

    reason: str
    where: str


class Reader(Protocol):
    """A dataset's raw files. Raises InputError, one line, where the root is not what it should be."""

    name: str
    skeleton: str

    def parts(self, root: Path) -> list[str]:
        """Names of what can be read on its own, sorted; also checks that the root is complete."""
        ...

    def read(self, root: Path, part: str) -> Iterator[LabeledSample | Skipped]:
        """Everybody in one part, in an order that never changes."""
        ...
