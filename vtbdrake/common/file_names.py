"""Names of files that are made of any text."""

from __future__ import annotations

import re
from hashlib import sha256

_LONGEST = 100
"""Characters that a name may have: a file system allows 255 bytes, suffixes included."""


def as_file_name(text: str) -> str:
    """Return a text as the name of a file, without its suffix: other characters than letters, digits, _ . - become _.

    A long one is cut, and ends with a digest of the whole text.

    Args:
        text: Any text.
    """
    name = re.sub(r"[^\w.-]+", "_", text, flags=re.ASCII)
    if len(name) <= _LONGEST:
        return name
    digest = sha256(text.encode(errors="surrogatepass")).hexdigest()[:8]
    return f"{name[: _LONGEST - len(digest) - 1]}-{digest}"
