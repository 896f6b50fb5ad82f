"""Figures that show themselves in a notebook, once, and open no window."""

from __future__ import annotations

from io import BytesIO

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


class Picture(Figure):
    """A matplotlib Figure that pyplot does not know.

    pyplot would keep it in memory, open a window on a desktop, and in a notebook show it beside the returned value.
    """

    def __init__(self, width: float, height: float) -> None:
        super().__init__(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(self)

    def _repr_png_(self) -> bytes:
        buffer = BytesIO()
        self.savefig(buffer, format="png", dpi=100)
        return buffer.getvalue()


def label(name: str, unit: str) -> str:
    """An axis label: ``sim.sys.payload.mass [kg]``; without brackets if there is no unit."""
    return name if unit in ("", "1") else f"{name} [{unit}]"


def finish(axes: Axes) -> None:
    """What all diagrams share: a pale grid, and no frame above and to the right."""
    axes.grid(True, color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
