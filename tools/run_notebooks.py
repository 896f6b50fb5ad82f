"""Run the notebooks and store them with their text and plots: ``python tools/run_notebooks.py [NAME...]``.

What a reader cannot use without a kernel is left out: widgets; recordings in 3D, which are large, and pages, whose
pictures stay.
"""

from __future__ import annotations

from pathlib import Path

import click
import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "notebooks"
WIDGET = "application/vnd.jupyter.widget-view+json"


def run(notebook: NotebookNode) -> NotebookNode:
    """Run a notebook from top to bottom in the root of the checkout, and return it with its outputs.

    Raises:
        nbclient.exceptions.CellExecutionError: A cell raised.
    """
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(ROOT)}}).execute()
    return notebook


def strip(notebook: NotebookNode) -> None:
    """Remove what a stored page cannot use: 3D recordings, pages, progress bars, log messages, times of execution."""
    notebook.metadata.pop("widgets", None)
    notebook.metadata.language_info = {"name": "python"}
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        if cell.cell_type != "code":
            continue
        outputs: list[NotebookNode] = []
        for output in cell.outputs:
            data = output.get("data", {})
            if WIDGET in data or output.get("name") == "stderr":
                continue
            if "image/png" in data or "<iframe" in data.get("text/html", ""):
                data.pop("text/html", None)
            if outputs and output.get("name") == outputs[-1].get("name") == "stdout":
                outputs[-1].text += output.text
            else:
                outputs.append(output)
        cell.outputs = outputs


@click.command()
@click.argument("names", nargs=-1)
def main(names: tuple[str, ...]) -> None:
    """Run the notebooks NAMES, or all, and store them."""
    for name in names or sorted(path.stem for path in FOLDER.glob("*.ipynb")):
        path = FOLDER / f"{name}.ipynb"
        notebook = run(nbformat.read(path, as_version=4))
        strip(notebook)
        nbformat.write(notebook, path)
        print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
