"""Training and test splits: published ones, and a user's own train.txt and test.txt.

Published splits are small files in `splits/` that name their source. A rule is one of

    sequences   a sequence's name is in a list
    folders     the first folder of a part's name is in a list
    chunks      every part is cut into runs of `length` people; a `share` of them is drawn for train with a seed
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

# file names of a user's own lists
_LISTS = {"train": "train.txt", "val": "val.txt", "test": "test.txt"}
# lists that a split requires
_NEEDED = ("train", "test")


@dataclass(frozen=True, kw_only=True)
class SplitRule:
    """A split. name, source; sets: split -> the names of its sequences or folders; leaks: the data of train that is
    also in test, "" for none; usual: whether it is the default of its dataset. See the module for rule, length, share
    and seed."""

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
        """The split of a part by its name, None if no list has it or the rule does not go by names."""
        name = self._name(part)
        return next((split for split, names in self.sets.items() if self.by_part and name in names), None)

    def _name(self, part: str) -> str:
        """The name of a part in lists: its first folder, or its full name."""
        return part.split("/")[0].removesuffix(".pkl") if self.rule == "folders" else part

    def of_chunks(self, part: str, people: int) -> list[str]:
        """The split of each person of a part, in order."""
        chunks = -(-people // self.length)
        part_seed = zlib.crc32(part.encode("utf-8", "backslashreplace"))
        order = np.random.default_rng([self.seed, part_seed]).permutation(chunks)
        train_chunks = set(order[: int(self.share * chunks)].tolist())
        return ["train" if k // self.length in train_chunks else "test" for k in range(people)]

    def absent(self, parts: list[str]) -> dict[str, list[str]]:
        """Split -> names in its list that match no part."""
        present_names = set(map(self._name, parts))
        missing_names = {
            split: [name for name in names if name not in present_names] for split, names in self.sets.items()
        }
        return {split: names for split, names in missing_names.items() if names}


def split_rule(dataset: str, root: Path, name: str | None = None, parts: Sequence[str] = ()) -> SplitRule | None:
    """The split to use: the published one called `name`; by default the user's own lists in `root` (train.txt, test.txt
    and val.txt, one part per line), else the dataset's usual one; None if there is none.

    parts: the names that the user's lists may contain; what precedes the first "/" may be omitted if the rest is
    unique. Raises InputError for an unknown name, a missing train or test list, a list that is empty or not text, lists
    that match no part, and a part in two lists.
    """
    rules = {rule.name: rule for rule in _published(dataset)}
    if name is not None:
        if not rules:
            remedy = "put train.txt and test.txt into its folder"
            raise InputError(f"{dataset} has no published splits, got {name!r}: {remedy}")
        check_name(f"split of {dataset}", name, rules)
        return rules[name]
    return _own(root, parts) or next((rule for rule in rules.values() if rule.usual), None)


def _own(root: Path, parts: Sequence[str]) -> SplitRule | None:
    paths = {split: root / file for split, file in _LISTS.items() if (root / file).is_file()}
    if not paths:
        return None
    missing_files = [_LISTS[split] for split in _NEEDED if split not in paths]
    if missing_files:
        present_file = next(iter(paths.values())).name
        raise file_error(root, f"has {present_file} and no {missing_files[0]}: add it, or remove the other")
    # names without their first folder, if only one part has that name
    short_name_counts = Counter(part.partition("/")[2] for part in parts)
    full_names = {name: part for part in parts if short_name_counts[name := part.partition("/")[2]] == 1} | {
        part: part for part in parts
    }
    sets: dict[str, tuple[str, ...]] = {}
    split_of: dict[str, str] = {}
    for split, path in paths.items():
        try:
            lines = decode(read_bytes(path, expected="names of sequences, one per line")).splitlines()
        except FormatError as problem:
            raise file_error(path, problem) from None
        # empty lines, such as at the end of the file, are not sequences
        names = [line.strip() for line in lines if line.strip()]
        if not names:
            raise file_error(path, "names no sequence; expected one per line")
        sets[split] = tuple(full_names.get(name, name) for name in names)
        for name in sorted(sets[split]):
            if split_of.setdefault(name, split) != split:
                raise file_error(path, f"names {name}, which is also in {_LISTS[split_of[name]]}: remove it from one")
    source = ", ".join(path.name for path in paths.values())
    if parts and not full_names.keys() & split_of.keys():
        example = sets[next(iter(sets))][0]
        raise file_error(root, f"has nothing named in {source}: expected names such as {parts[0]!r}, got {example!r}")
    return SplitRule(name="own", source=f"{source} beside the data", rule="sequences", sets=sets)


def _published(dataset: str) -> Iterator[SplitRule]:
    folder = files("lidarpose.data") / "splits"
    for file in sorted(folder.iterdir(), key=lambda file: file.name):
        if not file.name.endswith(".json"):
            continue
        rule = json.loads(file.read_text("utf-8"))
        if rule.pop("dataset") == dataset:
            sets = {split: tuple(names) for split, names in rule.pop("sets").items()}
            yield SplitRule(sets=sets, **rule)
