"""Every notebook has its test."""

from pathlib import Path

from tools.run_notebooks import FOLDER


def test_every_notebook_has_a_test() -> None:
    names = {path.stem for path in FOLDER.glob("*.ipynb")}
    assert names
    assert {path.stem.removeprefix("test_") for path in Path(__file__).parent.glob("test_*.py")} - {"all"} == names
