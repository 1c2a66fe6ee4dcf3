"""What the docs name is there."""

import re
from pathlib import Path

import pytest

import lidarpose

SOURCE = Path(lidarpose.__file__).parent
DOCS = Path(__file__).parents[1] / "docs"
NAMED = sorted(set(re.findall(r"`([\w/]+\.py): ([\w.]+)", (DOCS / "method.md").read_text())))


def test_the_table_of_the_paper_s_method_is_read():
    assert len(NAMED) > 20


@pytest.mark.parametrize("path, name", NAMED, ids=[f"{path}:{name}" for path, name in NAMED])
def test_what_stands_beside_the_paper_is_there(path, name):
    file = next((p for p in (SOURCE / "models" / path, SOURCE / path) if p.is_file()), None)
    assert file is not None, path
    text = file.read_text()
    for part in name.split("."):
        assert re.search(rf"(class|def) {part}\b|self\.{part} = |^ *{part}: ", text, re.MULTILINE), part
