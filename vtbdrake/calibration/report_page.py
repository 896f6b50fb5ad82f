"""Pages of results that a browser opens."""

from __future__ import annotations

import os
from html import escape

from vtbdrake.state.archive import whole_file


def save_page(path: str | os.PathLike[str], title: str, body: str) -> None:
    """Write one HTML file, completely or not at all.

    Args:
        path: The file.
        title: The title, as text.
        body: The content, as HTML.
    """
    with whole_file(path) as partial:
        partial.write_text(f'<!doctype html><meta charset="utf-8"><title>{escape(title)}</title>{body}', "utf-8")
