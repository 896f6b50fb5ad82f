"""Suggestions of names for a name that was mistyped."""

from __future__ import annotations

from collections.abc import Iterable


def did_you_mean(name: str, names: Iterable[str], *, count: int = 3, cutoff: float = 0.6) -> str:
    """Return the end of an error message that suggests similar names, such as ``"; did you mean pitch?"``.

    Args:
        name: What was given.
        names: What would have been right.
        count: The largest number of names that are suggested.
        cutoff: How similar they must be, from 0 (nothing in common) to 1 (equal).

    Returns:
        The text, which is empty if no name is similar.
    """
    import difflib  # Here: few names are mistyped, and `import vtbdrake` should stay quick.

    by_folded: dict[str, list[str]] = {}  # `Time` is near `time`.
    for each in dict.fromkeys(names):
        by_folded.setdefault(each.casefold(), []).append(each)
    matches = difflib.get_close_matches(name.casefold(), list(by_folded), n=count, cutoff=cutoff)
    near = [each for match in matches for each in by_folded[match]][:count]
    return f"; did you mean {' or '.join(near)}?" if near else ""
