"""How options are written."""


def names(text: str) -> tuple[str, ...]:
    """The names in a list that commas part."""
    return tuple(name.strip() for name in text.split(",") if name.strip())
