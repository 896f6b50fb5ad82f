"""Errors and objects in a notebook: the user's lines of an error, and tables and frames of what is shown."""

from __future__ import annotations

import re
import traceback
from collections.abc import Callable
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from vtbdrake.common.notebook_errors import users_part
from vtbdrake.optimization import Parameter, Study
from vtbdrake.rollout import Quality

ROOT = Path(__file__).parents[2]


def raised_by(wrong: Callable[[], object]) -> BaseException:
    try:
        wrong()
    except Exception as error:
        return error
    raise AssertionError("nothing was raised")


def lines(error: BaseException) -> list[str]:
    """The functions of the part of an error's traceback that is shown."""
    return [frame.name for frame in traceback.extract_tb(users_part(error))]


def test_error_of_the_package_ends_at_the_users_line() -> None:
    for wrong in (
        lambda: Parameter("sim.x", 3.0, 1.0),  # in the method of a dataclass, which is made without a file
        lambda: Study.open("there-is-none.db"),
        lambda: Quality(abs, of=[]),
    ):
        assert lines(raised_by(wrong)) == ["raised_by", "<lambda>"]


def test_error_inside_the_package_is_shown_whole() -> None:
    # As a fault of the package: nothing there raises it.
    assert lines(raised_by(lambda: Parameter.as_value(None, 1.0)))[-1] == "as_value"  # type: ignore[arg-type]


def test_error_of_the_users_function_is_shown_whole() -> None:
    def half(theta: float) -> float:
        return theta / 0.0

    assert lines(raised_by(lambda: half(1.0)))[-1] == "half"


CELLS = """
import vtbdrake as vtb
vtb.Parameter("sim.x", 3.0, 1.0)
---
%tb
---
1 / 0
---
vtb.Quality(lambda theta: theta / 0.0, of=["theta"])([1.0], time=0.0)
---
from vtbdrake.visualization import make_meshcat
make_meshcat()
---
vtb.Parameter("sim.x", 1.0, 3.0, log=True)
---
vtb.Interface(sense=[vtb.Signal("angle", size=2, unit="rad")], act=[])
"""


@pytest.mark.slow
@pytest.mark.one_python
def test_notebook_shows_errors_and_objects() -> None:
    cells = [nbformat.v4.new_code_cell(source.strip()) for source in CELLS.split("---")]
    notebook = nbformat.v4.new_notebook(cells=cells)
    NotebookClient(notebook, timeout=300, allow_errors=True, resources={"metadata": {"path": ROOT}}).execute()

    def error(cell: int) -> list[str]:
        (text,) = ("\n".join(o.traceback) for o in cells[cell].outputs if o.output_type == "error")
        return re.sub(r"\x1b\[[0-9;]*m", "", text).splitlines()

    def shown(cell: int) -> str:
        return str(cells[cell].outputs[-1].data["text/html"])

    short = error(0)
    assert len(short) <= 8 and not any("File" in line for line in short)
    assert "lower < upper, but it is [3.0, 1.0]" in short[-1]
    assert any("%tb" in output.get("text", "") for output in cells[0].outputs)
    assert len(error(1)) > len(short) and any("parameter.py" in line for line in error(1))
    assert error(2)[-1] == "ZeroDivisionError: division by zero"
    # The user's own error, from which it came, is shown with it.
    assert any("theta / 0.0" in line for line in error(3)) and "QualityError" in error(3)[-1]
    assert re.search(r'<a href="(http://127[^"]+)".*<iframe src="\1"', shown(4))
    assert "127." not in cells[4].outputs[-1].data["text/plain"]
    assert "<td>range</td><td>[1, 3]</td>" in shown(5) and "on a logarithmic scale" in shown(5)
    assert "<td>sensor</td><td>angle</td><td>2</td><td>rad</td>" in shown(6)
