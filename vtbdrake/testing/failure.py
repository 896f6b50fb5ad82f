"""Failed assertions: their message, and the plot that is written beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FOLDER = Path(".vtb_failures")
"""The folder of plots and logs of failures, below the present directory; pytest's option ``--vtb-failures``."""

_folder: ContextVar[Path | None] = ContextVar("folder of failures", default=FOLDER)


@contextmanager
def failures_in(folder: Path | None) -> Iterator[None]:
    """Write the plots of failures into a folder, for the time of a ``with`` block; None: write none."""
    token = _folder.set(folder)
    try:
        yield
    finally:
        _folder.reset(token)


def fail(message: str, *, name: str, draw: Callable[[Axes], None] | None = None) -> NoReturn:
    """Raise an AssertionError, with the path of a plot if there is something to draw.

    Args:
        message: What was expected, and the first time and address at which it was not so.
        name: Name of the assertion, for the name of the file.
        draw: Draws into the axes of the plot.
    """
    __tracebackhide__ = True
    if draw is not None and (folder := _folder.get()) is not None:
        message += f"\nplot: {_written(folder, name, draw)}"
    raise AssertionError(message)


def _written(folder: Path, name: str, draw: Callable[[Axes], None]) -> str:
    from vtbdrake.visualization.plots import Picture, finish

    picture = Picture(7.0, 3.5)
    axes = picture.add_subplot()
    draw(axes)
    finish(axes)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path = next(p for p in _names(folder, name) if not p.exists())
        picture.savefig(path, dpi=100)
    except OSError as error:  # The failure itself is what has to be told.
        return f"not written ({error})"
    return str(path.absolute())


def _names(folder: Path, name: str) -> Iterator[Path]:
    yield folder / f"{name}.png"
    number = 2
    while True:
        yield folder / f"{name}_{number}.png"
        number += 1
