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

    near = difflib.get_close_matches(name, list(dict.fromkeys(names)), n=count, cutoff=cutoff)
    return f"; did you mean {' or '.join(near)}?" if near else ""
