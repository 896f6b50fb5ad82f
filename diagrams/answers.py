"""Print every application's question and our answer beside the paper's.

``python -m vtbdrake_diagrams.answers [ONLY...] [--full]`` prints one row each, and writes the answers of this run to
``answers.json``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import isinf
from pathlib import Path
from typing import Any

import click

from vtbdrake.cli.output import table
from vtbdrake_diagrams.tables import Crash, Registry, run, selected_names, write_json

# Application -> payload(full) -> Answer
APPLICATIONS: Registry = {
    "O1": "vtbdrake_diagrams.satellite.studies.mount:mount",
    "O2": "vtbdrake_diagrams.satellite.studies.scan_answer:frequency",
    "O3": "vtbdrake_diagrams.satellite.studies.lighting:lighting",
    "O4": "vtbdrake_diagrams.space_climber.studies.answers:payload",
    "R1": "vtbdrake_diagrams.space_climber.studies.answers:heading",
    "R2": "vtbdrake_diagrams.satellite.studies.trajectory:answer",
    "C1": "vtbdrake_diagrams.manipulator.studies.answers:control",
    "C2": "vtbdrake_diagrams.forest.studies.answers:localization",
}

FILE = "answers.json"
FIELDS = ("id", "answer", "unit", "interval", "paper", "cases", "held_out", "baseline", "refused", "seconds", "holds")


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The answer to the question of one application.

    Attributes:
        id: Name of the application: O1 to O4, R1, R2, C1, C2.
        question: Question in one sentence.
        answer: A number in ``unit``, or words.
        unit: SI; empty for words.
        interval: (lower, upper), in which the answer lies; an infinite end is open. None if it has no uncertainty.
        paper: The paper's answer.
        cases: On which cases the answer was found, in words.
        held_out: On which others it is judged, in words; empty if it is judged on the same.
        baseline: What an engineer would take instead, and its result; empty if the row has none.
        refused: The number of cases that have no answer.
        holds: Whether the criterion of the application is met.
        note: Further information.
        seconds: Seconds of wall time; measured if left out.
    """

    id: str
    question: str
    answer: float | str
    unit: str
    interval: tuple[float, float] | None
    paper: str
    cases: str
    held_out: str
    baseline: str
    refused: int = 0
    holds: bool
    note: str = ""
    seconds: float | None = None


def answer_all(
    only: Sequence[str] = (),
    *,
    full: bool = False,
    registry: Registry = APPLICATIONS,
    echo: Callable[[str], Any] = print,
) -> list[Answer | Crash]:
    """Run the named applications, or all. One that raises becomes a `Crash`, and the others still run.

    Args:
        only: The names of the applications; by default all.
        full: Run the long versions.
        registry: Name -> function ``(full) -> Answer``.
        echo: Gets a line when an application begins.

    Raises:
        ValueError: A name is unknown.
    """
    answers: list[Answer | Crash] = []
    for name in selected_names(registry, only):
        echo(f"{name} ...")
        begin = time.perf_counter()
        answer = run(registry, name, full)
        if isinstance(answer, Answer) and answer.seconds is None:
            answer = replace(answer, seconds=time.perf_counter() - begin)
        answers.append(answer)
    return answers


def answers_table(answers: Sequence[Answer | Crash]) -> str:
    """Return the table of the answers, with the notes below it."""
    header = ("id", "question", "answer", "the paper's", "time", "holds")
    rows = [_crash_row(a) if isinstance(a, Crash) else _row(a) for a in answers]
    notes = [_note(answer) for answer in answers if isinstance(answer, Answer)]
    return "\n".join([table(header, rows), *notes])


def _note(answer: Answer) -> str:
    judged = answer.held_out or "the same"
    refused = f"; {answer.refused} without an answer" if answer.refused else ""
    evidence = f"found on {answer.cases}; judged on {judged}{refused}; instead: {answer.baseline or 'no baseline'}."
    return f"{answer.id}: {evidence} {answer.note}".rstrip()


def _row(answer: Answer) -> tuple[str, ...]:
    value = answer.answer if isinstance(answer.answer, str) else _number(answer.answer)
    parts = [value, answer.unit, _interval(answer.interval)]
    return (
        answer.id,
        answer.question,
        " ".join(part for part in parts if part),
        answer.paper,
        f"{answer.seconds:.1f} s",
        "yes" if answer.holds else "NO",
    )


def _crash_row(crash: Crash) -> tuple[str, ...]:
    return (crash.name, "", str(crash), "", "", "NO")


def _interval(interval: tuple[float, float] | None) -> str:
    if interval is None:
        return ""
    lower, upper = interval
    left = "(-inf" if isinf(lower) else f"[{_number(lower)}"
    right = "inf)" if isinf(upper) else f"{_number(upper)}]"
    return f"in {left}, {right}"


def _number(value: float) -> str:
    """Return a number with as many digits as an answer may claim."""
    return f"{value:.3g}"


def write_answers(path: Path, answers: Sequence[Answer | Crash]) -> None:
    """Write the answers with the fields `FIELDS`; a crash has neither answer nor time, and does not hold."""
    write_json(path, [_fields(answer) for answer in answers])


def _fields(answer: Answer | Crash) -> dict[str, Any]:
    if isinstance(answer, Crash):
        return {**dict.fromkeys(FIELDS), "id": answer.name, "holds": False}
    return {name: getattr(answer, name) for name in FIELDS}


@click.command()
@click.argument("only", nargs=-1)
@click.option("--full", is_flag=True, help="The long versions.")
def main(only: tuple[str, ...], full: bool) -> None:
    """Answer the questions of the applications ONLY (for example O4), or of all.

    The exit code is 1 if a row does not hold.
    """
    try:
        answers = answer_all(only, full=full, echo=lambda line: click.echo(line, err=True))
    except ValueError as error:
        raise click.UsageError(str(error)) from error
    write_answers(Path(FILE), answers)
    click.echo(answers_table(answers))
    if not all(isinstance(answer, Answer) and answer.holds for answer in answers):
        raise SystemExit(1)


if __name__ == "__main__":
    # Under its own name, so that there is one class Answer.
    from vtbdrake_diagrams.answers import main as program

    program(prog_name="python -m vtbdrake_diagrams.answers")
