"""The programs in README.md and docs/ run and print what the pages show, and their links lead somewhere."""

import ast
import os
import re
import runpy
import subprocess
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import click
import pytest

import vtbdrake
from tests.visualization.meshcat_page import messages
from tools.recordings import RECORDINGS
from vtbdrake.cli import main

pytestmark = pytest.mark.one_python

ROOT = Path(__file__).resolve().parents[1]
ROOTS = [ROOT, ROOT / "vtbdrake"]
AT_THE_ROOT = [ROOT / name for name in ("README.md", "ARCHITECTURE.md", "CHANGELOG.md")]
PAGES = [*AT_THE_ROOT, *sorted((ROOT / "docs").rglob("*.md"))]
# Pages at the root that are no part of the site.
BESIDE_THE_SITE = [ROOT / name for name in ("AGENTS.md", "CONTRIBUTING.md", "SECURITY.md")]
# The same programs with fewer and shorter rollouts.
SHORTER = {
    "campaigns": {"horizon: 4.0": "horizon: 1.0"},
    "crater": {"horizon=6.0": "horizon=2.0, candidates=3, executor='serial'"},
    "machine": {"seconds=2.0": "seconds=0.5"},
    "policies": {"runtime.run(seconds=2.0)": "runtime.run(seconds=0.5)"},
    # Until the fingers hold the bar; tests/diagrams/satellite/test_capture.py waits longer.
    "satellite": {"AdvanceTo(20.0)": "AdvanceTo(14.0)", "== Mode.HOLD": "== Mode.RETREAT"},
    "studies": {"run(rollouts=40)": "run(rollouts=16)", "rollouts=60": "rollouts=24", "horizon=5.0": "horizon=2.0"},
    "tutorial": {"horizon=3.0, threshold": "horizon=1.0, threshold"},
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


# The others run in the process of the tests, which has imported most of what they need. These are a program as a user
# starts one, one whose processes begin by its file, one that gets real-time priority, and those that serve pages.
IN_A_PROCESS = ("README", "cluster", "machine", "study_page", "view", "viewers", "vr")

# One is run in the quick suite, too: it needs no worker processes.
QUICK = "recordings"
WITH_PROGRAM = [page for page in PAGES if program(page).strip()]


@pytest.mark.parametrize("page", WITH_PROGRAM, ids=lambda page: page.stem)
def test_program_of_a_page_names_what_is_there(page: Path) -> None:
    """Names that a program imports of the package and the testbeds exist; a quick test beside the one that runs it."""
    for node in ast.walk(ast.parse(program(page))):
        if isinstance(node, ast.Import):
            assert all(find_spec(name.name) for name in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module.startswith("vtbdrake"):
            module = import_module(node.module)
            missing = [name.name for name in node.names if not hasattr(module, name.name)]
            assert not [name for name in missing if not find_spec(f"{node.module}.{name}")]


def shortened(page: Path) -> str:
    """Return the program of a page, with fewer and shorter rollouts."""
    text = program(page)
    for old, new in SHORTER.get(page.stem, {}).items():
        assert old in text
        text = text.replace(old, new)
    return text


def run_in_a_process(script: Path, environment: dict[str, str]) -> str:
    done = subprocess.run(
        [sys.executable, script],
        cwd=script.parent,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    return done.stdout


@pytest.mark.parametrize(
    "page",
    [pytest.param(page, marks=[] if page.stem == QUICK else [pytest.mark.slow]) for page in WITH_PROGRAM],
    ids=lambda page: page.stem,
)
def test_program_of_a_page_runs(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = tmp_path / f"{page.stem}.py"
    script.write_text(shortened(page), "utf-8")
    search = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    monkeypatch.setenv("PYTHONPATH", search)
    monkeypatch.setenv("MPLBACKEND", "agg")
    if page.stem in IN_A_PROCESS:
        printed = run_in_a_process(script, dict(os.environ))
    else:
        monkeypatch.chdir(tmp_path)
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.setattr(sys, "argv", [str(script)])
        runpy.run_path(str(script), run_name="__main__")
        printed = capsys.readouterr().out
    for block in re.findall(r"^```output\n(.*?)^```", page.read_text("utf-8"), re.MULTILINE | re.DOTALL):
        assert block in printed


def test_page_for_coding_assistants_is_short_and_names_commands() -> None:
    text = (ROOT / "AGENTS.md").read_text("utf-8")
    commands = re.findall(r"(?:^    |`)vtbdrake ([a-z]+)\b", text, re.MULTILINE)
    assert len(text.splitlines()) <= 60 and len(re.findall(r"^    vtbdrake .* --json$", text, re.MULTILINE)) == 5
    assert len(commands) > 7 and set(commands) <= set(main.list_commands(click.Context(main)))


@pytest.mark.parametrize("page", [*PAGES, *BESIDE_THE_SITE], ids=lambda page: page.stem)
def test_links_and_paths_of_a_page_exist(page: Path) -> None:
    text = page.read_text("utf-8")
    links = [link for link in re.findall(r"\]\(([^)#]+)", text) if "://" not in link]
    paths = re.findall(r"`([\w./]+(?:/|\.pyx?))`", text)
    missing = [link for link in links if not (page.parent / link).exists()]
    missing += [path for path in paths if not any((root / path).exists() for root in ROOTS)]
    assert not missing, f"{page.name} names what is not there: {missing}"


def test_index_lists_every_page() -> None:
    index = ROOT / "docs" / "index.md"
    found = re.findall(r"\]\(([^)#:]+\.(?:md|ipynb))\)", index.read_text("utf-8"))
    links = {(index.parent / link).resolve() for link in found}
    assert links == {*PAGES, *(ROOT / "notebooks").glob("*.ipynb")} - {index, ROOT / "README.md"}


def test_recordings_of_the_gallery_move() -> None:
    kept = {path.stem for path in (ROOT / "docs" / "gallery").glob("*.npz")}
    gallery = (ROOT / "docs" / "gallery.md").read_text("utf-8")
    assert kept == set(RECORDINGS) and all(f"(gallery/{name}.png)" in gallery for name in kept)
    page = RECORDINGS["cart_pole"].page(ROOT / "docs" / "gallery" / "cart_pole.npz")
    (animation,) = [message for message in messages(page) if message["type"] == "set_animation"]
    places = [
        {tuple(key["value"]) for key in track["keys"]}
        for moved in animation["animations"]
        for track in moved["clip"]["tracks"]
        if track["name"] == ".position"
    ]
    assert max(map(len, places)) > 50


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_blocks_of_one_thing_stand_together(page: Path) -> None:
    """The site shows them as tabs: a label in Python and one on the command line, each right above its block."""
    text = page.read_text("utf-8")
    labels = re.findall(r"^\*\*(In Python|On the command line)\*\*\n\n```(\w+)$", text, re.MULTILINE)
    assert len(labels) == len(re.findall(r"^\*\*(?:In Python|On the command line)\*\*", text, re.MULTILINE))
    pairs = [sorted(labels[k : k + 2]) for k in range(0, len(labels), 2)]
    assert all(pair == [("In Python", "python"), ("On the command line", "sh")] for pair in pairs)


def lines_outside_code(page: Path) -> list[tuple[int, str]]:
    """Return the lines of a page outside of code blocks, with their numbers, which begin with 1."""
    lines, inside = [], False
    for number, line in enumerate(page.read_text("utf-8").split("\n"), start=1):
        if re.match(r"\s*(?:[*-] |\d+\. )?```", line):
            inside = not inside
        elif not inside:
            lines.append((number, line))
    return lines


def cells(row: str) -> list[str]:
    """Return the texts that a reader sees in a row of a table: without link targets and backticks."""
    texts = [re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", cell) for cell in re.split(r"(?<!\\)\|", row.strip())[1:-1]]
    return [text.replace("`", "").strip() for text in texts]


@pytest.mark.parametrize("page", [*PAGES, *BESIDE_THE_SITE], ids=lambda page: page.stem)
def test_page_has_short_lines_and_short_cells(page: Path) -> None:
    """Lines of at most 120 columns outside code and tables, unless a link is longer; table cells of at most 80."""
    lines = lines_outside_code(page)
    rows = [(number, line) for number, line in lines if line.lstrip().startswith("|")]
    too_long = [(n, len(line)) for n, line in lines if len(line) > 120 and (n, line) not in rows and "](" not in line]
    assert not too_long, f"{page.name} has lines above 120 columns: {too_long}"
    too_wide = [(n, cell) for n, row in rows for cell in cells(row) if len(cell) > 80]
    assert not too_wide, f"{page.name} has table cells above 80 characters, make the table a list: {too_wide}"


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


@pytest.mark.slow
def test_quoted_errors_are_those_of_the_code() -> None:
    texts = "\n".join(texts_of_the_package())
    quoted = re.findall(r"^\* `(.*?)`", (ROOT / "docs" / "errors.md").read_text("utf-8"), re.MULTILINE)
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
