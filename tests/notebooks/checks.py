"""Checks of a notebook: it runs, shows each figure once, and is stored with its text and plots."""

import re
from collections.abc import Collection, Mapping

import nbformat
import numpy as np
from nbformat import NotebookNode

from tools.run_notebooks import FOLDER, run


def stored(name: str) -> NotebookNode:
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    nbformat.validate(notebook)
    return notebook


def code_cells(notebook: NotebookNode) -> list[NotebookNode]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def pictures(cell: NotebookNode) -> int:
    return sum("image/png" in output.get("data", {}) for output in cell.outputs)


def check_stored(name: str) -> None:
    """Check that a reader without a kernel sees text and plots, and nothing of the machine that made them."""
    notebook = stored(name)
    assert notebook.metadata.kernelspec.name == "python3"
    assert "widgets" not in notebook.metadata
    for cell in code_cells(notebook):
        assert cell.execution_count, f"{cell.id} has not been run: python tools/run_notebooks.py {name}"
        text = str(cell.outputs)
        assert "<iframe" not in text, f"{cell.id} holds a 3D recording"
        assert not re.search(r"/(home|root|tmp|work|usr)/", text), f"{cell.id} shows a path of a machine"


def printed(cell: NotebookNode) -> str:
    """Return what a cell has printed and shown as text."""
    data = [output.get("data", {}) for output in cell.outputs]
    texts = [output.get("text", "") for output in cell.outputs]
    return "\n".join([*texts, *(one.get(kind, "") for one in data for kind in ("text/plain", "text/html"))])


# How text may write a number of the code: as it is, in mm or %, in thousands, in degrees.
SCALES = (1.0, 100.0, 1000.0, 1e-3, 180.0 / np.pi)
NUMBER = r"\d+(?:\.\d+)?"


def check_numbers(name: str, *, given: Collection[str]) -> None:
    """Check that each number in the text is one of the code or of what it prints, as far as the text writes it out.

    ``given`` are the others: years, volumes, and what the code takes from elsewhere.
    """
    notebook = stored(name)
    shown = "\n".join(f"{cell.source}\n{printed(cell)}" for cell in code_cells(notebook))
    known = np.outer([float(number) for number in re.findall(rf"{NUMBER}(?:e-?\d+)?", shown)], SCALES).ravel()
    unknown = set()
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            text = re.sub(r"\]\([^)]*\)|`[^`]*`", "", cell.source)  # Targets of links and names.
            for number in re.findall(rf"(?<![\w.\-/]){NUMBER}", text):
                rounding = 0.5 * 10.0 ** -len(number.partition(".")[2])
                if not (np.abs(known - float(number)) <= rounding + 1e-12).any():
                    unknown.add(number)
    assert unknown == set(given)


def check_runs(name: str, *, shorter: Mapping[str, str]) -> None:
    """Run the notebook: its own assertions hold, nothing warns, and each figure is shown once, as it is stored.

    ``shorter`` replaces pieces of its code, so that the same cells take less time.
    """
    before = {cell.id: cell for cell in code_cells(stored(name))}
    notebook = stored(name)
    for old, new in shorter.items():
        (cell,) = (cell for cell in code_cells(notebook) if old in cell.source)
        cell.source = cell.source.replace(old, new)
    for cell in code_cells(run(notebook)):
        lines = "".join(output.text for output in cell.outputs if output.get("name") == "stderr").splitlines()
        warnings = [line for line in lines if line and not line.startswith("INFO:")]  # such as Meshcat's address
        assert not warnings, f"{cell.id} warns: {warnings}"
        if "Scene in 3D" in str(cell.outputs):  # It has a picture where the machine can render.
            continue
        expected = any(word in cell.source for word in ("plot()", "plot_", "plt.show()", "display(draw("))
        assert pictures(cell) == pictures(before[cell.id]) == expected, cell.id
