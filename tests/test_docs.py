"""The programs in README.md and docs/ run and print what the pages show, and their links lead somewhere."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import vtbdrake

pytestmark = pytest.mark.one_python

ROOT = Path(__file__).resolve().parents[1]
ROOTS = [ROOT, ROOT / "vtbdrake"]
AT_THE_ROOT = [ROOT / name for name in ("README.md", "ARCHITECTURE.md", "CHANGELOG.md")]
PAGES = [*AT_THE_ROOT, *sorted((ROOT / "docs").rglob("*.md"))]
# The same programs with fewer rollouts.
SHORTER = {
    "crater": {"horizon=6.0": "horizon=6.0, candidates=3, executor='serial'"},
    "studies": {"run(rollouts=40)": "run(rollouts=16)", "rollouts=60": "rollouts=24"},
}


def program(page: Path) -> str:
    """Return the Python blocks of a page, one after the other, with their lines where the page has them."""
    lines = page.read_text("utf-8").split("\n")
    inside, kept = False, []
    for line in lines:
        if line.startswith("```"):
            inside = not inside and line == "```python"
            kept.append("")
        else:
            kept.append(line if inside else "")
    return "\n".join(kept)


WITH_PROGRAM = [
    pytest.param(page, id=page.stem, marks=[pytest.mark.slow] if page.stem == "README" else [])
    for page in PAGES
    if program(page).strip()
]


@pytest.mark.parametrize("page", WITH_PROGRAM)
def test_program_of_a_page_runs(page: Path, tmp_path: Path) -> None:
    script = tmp_path / f"{page.stem}.py"
    text = program(page)
    for old, new in SHORTER.get(page.stem, {}).items():
        assert old in text
        text = text.replace(old, new)
    script.write_text(text, "utf-8")
    search = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    environment = os.environ | {"PYTHONPATH": search, "MPLBACKEND": "agg"}
    done = subprocess.run(
        [sys.executable, script],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    for block in re.findall(r"^```output\n(.*?)^```", page.read_text("utf-8"), re.MULTILINE | re.DOTALL):
        assert block in done.stdout


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_and_paths_of_a_page_exist(page: Path) -> None:
    text = page.read_text("utf-8")
    links = [link for link in re.findall(r"\]\(([^)#]+)", text) if "://" not in link]
    paths = re.findall(r"`([\w./]+(?:/|\.pyx?))`", text)
    missing = [link for link in links if not (page.parent / link).exists()]
    missing += [path for path in paths if not any((root / path).exists() for root in ROOTS)]
    assert not missing, f"{page.name} names what is not there: {missing}"


def test_index_lists_every_page() -> None:
    index = ROOT / "docs" / "index.md"
    links = {(index.parent / link).resolve() for link in re.findall(r"\]\(([^)#:]+\.md)\)", index.read_text("utf-8"))}
    assert links == {*PAGES} - {index, ROOT / "README.md"}


def texts_of_the_package() -> list[str]:
    """Return the texts in the code of the package, with an ellipsis for what is filled in."""
    texts = []
    for path in (ROOT / "vtbdrake").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.JoinedStr):
                parts = [part.value if isinstance(part, ast.Constant) else "…" for part in node.values]
                texts.append("".join(map(str, parts)))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                texts.append(node.value)
    return texts


def test_quoted_errors_are_those_of_the_code() -> None:
    texts = "\n".join(texts_of_the_package())
    quoted = re.findall(r"^\| `(.*?)` \|", (ROOT / "docs" / "errors.md").read_text("utf-8"), re.MULTILINE)
    assert len(quoted) > 30
    patterns = [".*".join(map(re.escape, message.strip("… ").split("…"))) for message in quoted]
    assert not [message for message, pattern in zip(quoted, patterns, strict=True) if not re.search(pattern, texts)]


def test_architecture_names_every_module_and_folder() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text("utf-8")
    package = sorted((ROOT / "vtbdrake").iterdir())
    names = [path.name for path in package if path.suffix == ".py" or (path / "__init__.py").exists()]
    assert not [name for name in names if name != "__init__.py" and f"`vtbdrake/{name}`" not in text]


def test_every_public_name_is_shown_to_users() -> None:
    pages = [*PAGES, *sorted((ROOT / "notebooks").glob("*.ipynb"))]
    shown = set(re.findall(r"\bvtb\.(\w+)", "\n".join(page.read_text("utf-8") for page in pages)))
    assert set(vtbdrake.__all__) == shown
    assert all(hasattr(vtbdrake, name) for name in vtbdrake.__all__)
