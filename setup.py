"""The README as a package index shows it; everything else is in pyproject.toml.

An index shows the text alone, so links and pictures need the repository's address, `Repository` under [project.urls].
Without one, links become plain text and pictures are left out.
"""

import re
import tomllib
from pathlib import Path

from setuptools import setup

ROOT = Path(__file__).parent


def index_readme(readme: str, repository: str | None) -> str:
    """The README with absolute links into the repository, or without links into it."""
    picture, link = r"!\[([^]]*)\]\((?!https?:)([^)]+)\)", r"(?<!!)\[([^]]+)\]\((?!https?:)([^)]+)\)"
    if repository is None:
        return re.sub(link, r"\1", re.sub(picture + r"\n*", "", readme))
    readme = re.sub(picture, rf"![\1]({repository}/raw/main/\2)", readme)
    return re.sub(link, rf"[\1]({repository}/blob/main/\2)", readme)


if __name__ == "__main__":
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    text = index_readme((ROOT / "README.md").read_text("utf-8"), project.get("urls", {}).get("Repository"))
    setup(long_description=text, long_description_content_type="text/markdown")
