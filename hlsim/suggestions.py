"""Suggestions for names that do not exist."""

import difflib
from collections.abc import Iterable


def suggest(name: str, names: Iterable[str]) -> str:
    """Return a question for an error message about a name, or "" if no name is similar.

    Args:
        name: Name that does not exist.
        names: Names that exist.

    >>> suggest("nal-r", ["nalr", "wdrc"])
    ' (did you mean nalr?)'
    >>> suggest("loud", ["nalr", "wdrc"])
    ''
    """
    similar = difflib.get_close_matches(name.lower(), names, n=1)
    return f" (did you mean {similar[0]}?)" if similar else ""
