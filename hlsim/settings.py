"""Names in configurations and recipes: the unknown ones are refused, with those that are allowed."""

from collections.abc import Iterable


def refuse_unknown(found: Iterable[str], allowed: Iterable[str], what: str, where: str = "") -> None:
    """Raise ValueError unless every name is allowed.

    Args:
        what: what the names are of, for the message: "network settings".
        where: where they stand: "in the recipe".
    """
    allowed = list(allowed)
    if unknown := sorted(set(found) - set(allowed)):
        place = f" {where}" if where else ""
        raise ValueError(f"unknown {what} {', '.join(unknown)}{place}; allowed: {', '.join(allowed)}")
