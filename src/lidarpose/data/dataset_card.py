"""dataset.json: the contents of a dataset and how it was made."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lidarpose._version import __version__
from lidarpose.data.rows import TABLES
from lidarpose.errors import InputError, counted
from lidarpose.io.atomic import write_atomic
from lidarpose.io.files import file_error, read_json
from lidarpose.skeleton import BODY26, skeleton

SCHEMA = 1
CARD = "dataset.json"
SENSOR_FRAME = "level frame at the sensor: x forward, y left, z up"
# singular of the items that a dataset counts
_SINGULAR = {"people": "person", "clips": "clip", "streets": "street", "parts": "part"}


def content_count(count: int, what: str) -> str:
    """ "1 street", "1,200 people"."""
    return counted(count, _SINGULAR.get(what, what), what)


@dataclass(frozen=True, kw_only=True)
class DatasetCard:
    """The contents of dataset.json: settings, which determine the content; count of persons, clips, streets or parts;
    per_shard: items per shard; tables; skeleton's name; version of the package that wrote it; frame of points and
    joints; about: license, quirks and parts of a real dataset; summary: of a finished dataset's content."""

    settings: dict[str, Any]
    count: int
    per_shard: int
    tables: tuple[str, ...]
    skeleton: str = BODY26.name
    version: str = __version__
    frame: str = SENSOR_FRAME
    about: dict[str, Any] = field(default_factory=dict)
    summary: dict[str, Any] | None = None

    @property
    def people(self) -> str:
        """The table of people: "people" for synthetic people, "labelled" for real ones."""
        return "labelled" if "labelled" in self.tables else "people"

    @property
    def writer(self) -> str:
        """The command that writes such a dataset."""
        return "lidarpose prepare" if self.people == "labelled" else "lidarpose synth"

    @property
    def shards(self) -> int:
        """Number of shards of a table."""
        return -(-self.count // self.per_shard)

    def size(self, shard: int) -> int:
        """Number of persons, clips, streets or parts in a shard."""
        return min(self.per_shard, self.count - shard * self.per_shard)

    def to_json(self) -> str:
        content = {
            **{"schema": SCHEMA, "version": self.version, "count": self.count, "per_shard": self.per_shard},
            **{"tables": self.tables, "unit": "m", "frame": self.frame, "skeleton": self.skeleton},
            **{"joints": skeleton(self.skeleton).joints, "settings": self.settings},
            **({"about": self.about} if self.about else {}),
            **({} if self.summary is None else {"summary": self.summary}),
        }
        return json.dumps(content, indent=2) + "\n"


_CARD_TYPES: dict[str, Callable[[Any], Any]] = {
    **{"settings": dict, "count": int, "per_shard": int, "tables": lambda names: tuple(map(str, names))},
    **{"skeleton": str, "version": str, "frame": str, "about": dict, "summary": dict},
}
_OPTIONAL = ("frame", "about", "summary")


def read_card(folder: str | Path) -> DatasetCard:
    """The card of a dataset's folder. Raises InputError if it is missing, damaged or of another schema."""
    path = Path(folder) / CARD
    if not Path(folder).exists():
        raise file_error(folder, "is not a dataset: there is no such folder; write one with lidarpose synth or prepare")
    if not path.is_file():
        raise file_error(folder, f"is not a dataset: {CARD} is missing; write one with lidarpose synth or prepare")
    try:
        content = read_json(path, expected="a dataset's card")
        if content["schema"] != SCHEMA:
            version = content.get("version", "of the version that wrote it")
            problem = f"has schema {content['schema']!r}, this lidarpose reads {SCHEMA}: install lidarpose {version}"
            raise file_error(path, problem)
        names = [name for name in _CARD_TYPES if name in content or name not in _OPTIONAL]
        card = DatasetCard(**{name: _CARD_TYPES[name](content[name]) for name in names})
    except InputError:
        raise
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        problem = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise file_error(path, f"is not a dataset's card ({problem})") from None
    if card.count < 1 or card.per_shard < 1 or not set(card.tables) <= set(TABLES):
        raise file_error(path, "is not a dataset's card: count, per_shard or tables are invalid")
    skeleton(card.skeleton)
    return card


def write_card(folder: str | Path, card: DatasetCard) -> None:
    """Writes dataset.json atomically."""
    write_atomic(Path(folder) / CARD, card.to_json())
