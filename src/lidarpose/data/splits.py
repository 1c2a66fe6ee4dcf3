"""Which people are for training and which for testing: published splits, and a user's own train.txt and test.txt.

Published ones are small files in `splits/` that name their source. A rule is one of

    sequences   a sequence's name is in a list
    folders     the first folder of a part's name is in a list
    chunks      of every part, runs of `length` people, a `share` of them drawn for train with a seed
"""

import json
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path

import numpy as np

from lidarpose.errors import InputError, check_name
from lidarpose.io.files import FormatError, file_error, read_bytes
from lidarpose.io.text import decode

# what a user's own lists are called
_LISTS = {"train": "train.txt", "val": "val.txt", "test": "test.txt"}
# without these there is no split
_NEEDED = ("train", "test")


@dataclass(frozen=True, kw_only=True)
class SplitRule:
    """name and source of a split; sets: split -> the names of its sequences or folders; leaks: what of train is also in
    test, "" for nothing; usual: whether it is the one of its dataset that is taken where nobody names one. See the
    module for rule, length, share and seed."""

    name: str
    source: str
    rule: str
    sets: dict[str, tuple[str, ...]] = field(default_factory=dict)
    length: int = 0
    share: float = 0.0
    seed: int = 0
    leaks: str = ""
    usual: bool = True

    @property
    def by_part(self) -> bool:
        """Whether all of a part is in one split."""
        return self.rule != "chunks"

    def of_part(self, part: str) -> str | None:
        """The split of a part, where it is told by its name."""
        if not self.by_part:
            return None
        name = part.split("/")[0].removesuffix(".pkl") if self.rule == "folders" else part
        return next((split for split, names in self.sets.items() if name in names), None)

    def of_chunks(self, part: str, people: int) -> list[str]:
        """The split of each of a part's people, in their order."""
        chunks = -(-people // self.length)
        drawn_by = zlib.crc32(part.encode("utf-8", "backslashreplace"))
        order = np.random.default_rng([self.seed, drawn_by]).permutation(chunks)
        train = set(order[: int(self.share * chunks)].tolist())
        return ["train" if k // self.length in train else "test" for k in range(people)]

    def absent(self, parts: list[str]) -> dict[str, list[str]]:
        """Split -> names in the list that no part has."""
        there = {part.split("/")[0].removesuffix(".pkl") if self.rule == "folders" else part for part in parts}
        missing = {split: [name for name in names if name not in there] for split, names in self.sets.items()}
        return {split: names for split, names in missing.items() if names}


def split_rule(dataset: str, root: Path, name: str | None = None, parts: Sequence[str] = ()) -> SplitRule | None:
    """The split to use: the published one called `name`; by default the user's own lists in `root` (train.txt, test.txt
    and val.txt, a part a line), else the dataset's usual one; None where it has none.

    parts: the names that the user's lists may have, also without what is before the first "/" where only one then has
    the name. Raises InputError for an unknown name, half of the lists, one that is empty or no text, lists of which no
    name is a part's, and a part in two of them.
    """
    published = {rule.name: rule for rule in _published(dataset)}
    if name is not None:
        if not published:
            own = "put train.txt and test.txt into its folder"
            raise InputError(f"{dataset} has no published splits, got {name!r}: {own}")
        check_name(f"split of {dataset}", name, published)
        return published[name]
    return _own(root, parts) or next((rule for rule in published.values() if rule.usual), None)


def _own(root: Path, parts: Sequence[str]) -> SplitRule | None:
    there = [split for split, file in _LISTS.items() if (root / file).is_file()]
    if not there:
        return None
    missing = [_LISTS[split] for split in _NEEDED if split not in there]
    if missing:
        raise file_error(root, f"has {_LISTS[there[0]]} and no {missing[0]}: add it, or take the other away")
    short = Counter(part.partition("/")[2] for part in parts)
    full = {part.partition("/")[2]: part for part in parts if short[part.partition("/")[2]] == 1}
    full |= {part: part for part in parts}
    sets: dict[str, tuple[str, ...]] = {}
    for split in there:
        path = root / _LISTS[split]
        try:
            lines = decode(read_bytes(path, expected="names of sequences, one a line")).splitlines()
        except FormatError as problem:
            raise file_error(path, problem) from None
        # a line end at the end of the file is no sequence
        names = [line.strip() for line in lines if line.strip()]
        sets[split] = tuple(full.get(name, name) for name in names)
        if not sets[split]:
            raise file_error(path, "names no sequence; expected one a line")
        for other in there[: there.index(split)]:
            if both := sorted(set(sets[split]) & set(sets[other])):
                raise file_error(path, f"names {both[0]}, which is in {_LISTS[other]} too: leave it out of one")
    source = ", ".join(_LISTS[split] for split in there)
    if parts and not any(name in full for names in sets.values() for name in names):
        got = sets[there[0]][0]
        raise file_error(root, f"has nothing that {source} name: expected names such as {parts[0]!r}, got {got!r}")
    return SplitRule(name="own", source=f"{source} beside the data", rule="sequences", sets=sets)


def _published(dataset: str) -> Iterator[SplitRule]:
    folder = files("lidarpose.data") / "splits"
    for file in sorted(folder.iterdir(), key=lambda file: file.name):
        if not file.name.endswith(".json"):
            continue
        found = json.loads(file.read_text("utf-8"))
        if found.pop("dataset") == dataset:
            sets = {split: tuple(names) for split, names in found.pop("sets").items()}
            yield SplitRule(sets=sets, **found)
