"""``make verify``: run the cases of this folder, and print what each has verified, with tolerance and error.

With ``--page FILE`` it also writes the page of the documentation; other arguments are pytest's.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import click
import pytest

FOLDER = Path(__file__).resolve().parent
PAGE = FOLDER.parents[1] / "docs" / "verification.md"
MODULES = ("test_model", "test_integrators", "test_worlds", "test_other_engines")

INTRODUCTION = """\
# Verification

What is verified here is what you simulate with: scenarios are built into testbeds, their integrators are chosen by a
`SimulatorConfig`, and bodies, contact, sensors, drives and compiled plants come from the package. The reference of
each case is a published number, a closed form, or another engine; never the same computation. The cases are in four
groups, because an integrator that controls its error hides the errors of a model, and one that conserves energy looks
right while its answer is wrong.

`make verify` runs all of them and prints this table (they are among the tests that CI runs, too):
{cases} cases with {rows} comparisons. `python -m tests.verification --page docs/verification.md` writes this page. The
errors were measured on the computer that has written it; errors of rounding differ on others.

Error and tolerance are the largest of all entries of the quantity, in its unit. Where a case is run in several ways,
by several integrators, say, each has its rows.
"""


@dataclass
class Case:
    """A test function: its lines of the table.

    Attributes:
        title: The first line of its docstring.
        text: The rest.
        rows: (variant, quantity, unit, error, tolerance) of every comparison.
    """

    title: str
    text: str
    rows: list[tuple[str, str, str, float, float]] = field(default_factory=list)

    def worst(self) -> list[tuple[str, str, str, float, float]]:
        """Return one row per variant, quantity and unit: the one nearest to its tolerance."""
        worst: dict[tuple[str, str, str], tuple[float, float]] = {}
        for variant, quantity, unit, error, tolerance in self.rows:
            key = variant, quantity, unit
            if key not in worst or error / tolerance > worst[key][0] / worst[key][1]:
                worst[key] = error, tolerance
        return [(*key, *values) for key, values in worst.items()]


class Table:
    """A plugin of pytest that collects what the cases have verified.

    Attributes:
        groups: Docstring of the module -> its cases by the name of the function.
    """

    def __init__(self) -> None:
        self.groups: dict[str, dict[str, Case]] = {}
        self._cases: dict[tuple[str, str], Case] = {}
        for module in MODULES:
            tree = ast.parse((FOLDER / f"{module}.py").read_text("utf-8"))
            cases = self.groups[ast.get_docstring(tree) or module] = {}
            for node in tree.body:
                if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
                    title, _, text = inspect.cleandoc(ast.get_docstring(node) or node.name).partition("\n")
                    cases[node.name] = self._cases[module, node.name] = Case(title, text.strip("\n"))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        path, _, name = report.nodeid.partition("::")
        function, _, variant = name.removesuffix("]").partition("[")
        for key, row in report.user_properties if report.when == "call" else ():
            if key == "verification":
                self._cases[Path(path).stem, function].rows.append(
                    (variant, row["quantity"], row["unit"], row["error"], row["tolerance"])
                )

    def lines(self) -> Iterator[str]:
        """Yield the table for a terminal."""
        for group, cases in self.groups.items():
            yield f"\n{group.splitlines()[0]}"
            for name, case in cases.items():
                if case.rows:
                    yield f"  {case.title}  [{name}]"
                for variant, quantity, unit, error, tolerance in case.worst():
                    label = f"{variant}: {quantity}" if variant else quantity
                    verdict = "" if error <= tolerance else "  FAILED"
                    yield f"    {label:<58} error {error:8.1e}, tolerance {tolerance:8.1e} {unit}{verdict}"

    def page(self) -> str:
        """Return the page of the documentation."""
        cases = [case for group in self.groups.values() for case in group.values() if case.rows]
        parts = [INTRODUCTION.format(cases=len(cases), rows=sum(len(case.rows) for case in cases))]
        for group, members in self.groups.items():
            parts.append(group_section(group))
            for case in members.values():
                if case.rows:
                    parts += [case_section(case), *_lines_of_page(case), ""]
        return "\n".join(parts)


def group_section(text: str) -> str:
    """Return the heading and the text of a group, from the docstring of its module."""
    title, _, rest = text.partition(":")
    return f"## {title}\n\n{_sentence(rest)}\n"


def case_section(case: Case) -> str:
    """Return the heading and the text of a case."""
    title, _, rest = case.title.partition(": ")
    text = case.text.replace("Reference:", "**Reference:**").replace("Tolerance:", "**Tolerance:**")
    paragraphs = (_filled(paragraph) for paragraph in text.strip("\n").split("\n\n"))
    return "\n\n".join([f"### {title.rstrip('.')}", *([_sentence(rest)] if rest else []), *paragraphs]) + "\n"


def _filled(paragraph: str) -> str:
    """Return a paragraph in lines of a page; equations, which are indented, stay as they are."""
    return paragraph if paragraph.startswith(" ") else textwrap.fill(paragraph, 120, break_on_hyphens=False)


def _sentence(text: str) -> str:
    text = text.strip()
    return text[:1].upper() + text[1:]


def _lines_of_page(case: Case) -> Iterator[str]:
    yield "| variant | quantity | error | tolerance | unit |"
    yield "|---|---|---|---|---|"
    for variant, quantity, unit, error, tolerance in case.worst():
        yield f"| {variant or '-'} | {quantity} | {error:.1e} | {tolerance:.1e} | {unit} |"


@click.command(context_settings={"ignore_unknown_options": True})
@click.option("--page", type=click.Path(path_type=Path), help="Also write this page of the documentation.")
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def main(page: Path | None, arguments: tuple[str, ...]) -> None:
    """Run the cases, print what each has verified, and exit as pytest does, whose ARGUMENTS are the others."""
    table: Any = Table()
    begin = time.perf_counter()
    code = pytest.main([*(str(FOLDER / f"{module}.py") for module in MODULES), "-q", *arguments], plugins=[table])
    click.echo("\n".join(table.lines()))
    click.echo(
        f"\n{sum(len(c.rows) for g in table.groups.values() for c in g.values())} comparisons in "
        f"{time.perf_counter() - begin:.0f} s"
    )
    if page and code == pytest.ExitCode.OK:
        missing = [c.title for g in table.groups.values() for c in g.values() if "Reference:" in c.text and not c.rows]
        if missing:
            raise click.UsageError(f"the page describes all cases, but these were not run: {'; '.join(missing)}")
        page.write_text(table.page(), "utf-8")
    raise SystemExit(int(code))


if __name__ == "__main__":
    main(prog_name="python -m tests.verification")
