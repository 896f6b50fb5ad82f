"""Every notebook has its test."""

from pathlib import Path

from tools.run_notebooks import FOLDER

LARGEST = 1_000_000  # bytes


def test_every_notebook_has_a_test() -> None:
    names = {path.stem for path in FOLDER.glob("*.ipynb")}
    assert names
    assert {path.stem.removeprefix("test_") for path in Path(__file__).parent.glob("test_*.py")} - {"all"} == names


def test_every_notebook_is_smaller_than_1_mb() -> None:
    sizes = {path.name: path.stat().st_size for path in FOLDER.glob("*.ipynb")}
    assert {name: size for name, size in sizes.items() if size > LARGEST} == {}
