"""HTML by which an object shows itself in a notebook: a table of names and values, and a figure beside it."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping
from html import escape
from io import BytesIO
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def png_of(figure: Figure, *, dpi: float = 100) -> bytes:
    """Return a figure as PNG.

    Args:
        figure: The figure.
        dpi: Pixels per inch of the figure's size.
    """
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def summary_html(title: str, rows: Mapping[str, object], figure: Figure | None = None) -> str:
    """Return HTML for a notebook: a title, a table of names and values, and a figure beside it.

    Args:
        title: The title, in bold.
        rows: The values by name, a row each; texts are escaped.
        figure: The figure; None for the table alone.
    """
    cells = "".join(f"<tr><td>{escape(name)}</td><td>{escape(str(value))}</td></tr>" for name, value in rows.items())
    image = "" if figure is None else image_html(figure)
    return f"<div><b>{escape(title)}</b><table>{cells}</table>{image}</div>"


def image_html(figure: Figure) -> str:
    """Return the HTML element of a figure, with its pixels."""
    return f'<img src="data:image/png;base64,{b64encode(png_of(figure, dpi=80)).decode()}">'
