"""mkdocs hooks for two pages: index.md is the README, and reference.md lists all public names."""

import re
from pathlib import Path

import lidarpose

ROOT = Path(__file__).parents[1]
README = "<!-- README.md -->"
NAMES = "<!-- public names -->"


def on_page_markdown(markdown: str, **_) -> str:
    if README in markdown:
        markdown = site_links((ROOT / "README.md").read_text("utf-8"))
    if NAMES in markdown:
        homes = lidarpose._HOMES
        entries = (f"::: {homes[name]}.{name}\n    options:\n      heading: lidarpose.{name}\n" for name in homes)
        markdown = markdown.replace(NAMES, "\n".join(entries))
    return markdown


def site_links(readme: str) -> str:
    """The README with the site's links: pages without docs/, and other files of the repository as plain text."""
    readme = re.sub(r"\[([^]]+)\]\((?!docs/|https?:)[^)]+\)", r"\1", readme)
    return readme.replace("](docs/cards)", "](cards/small.md)").replace("](docs/", "](")
