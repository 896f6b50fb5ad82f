"""The tables of answers and of benchmarks: rows, files, names, and what becomes of errors."""

import json
import re
import subprocess
import sys
from dataclasses import replace
from math import inf, nan
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from benchmarks.import_time import import_time
from benchmarks.measure import Benchmark, interleaved, interleaved_values, ratio
from benchmarks.report import BENCHMARKS, ONLY_BY_NAME, benchmark_all, results_page, results_table, write_results
from vtbdrake_diagrams.answers import APPLICATIONS, FIELDS, Answer, answer_all, answers_table, main, write_answers
from vtbdrake_diagrams.tables import Crash, write_json

pytestmark = pytest.mark.one_python

ROOT = Path(__file__).resolve().parents[1]

HEAVY = Answer(
    id="O4",
    question="How heavy?",
    answer=43.0,
    unit="kg",
    interval=(43.0, 44.0),
    paper="about 45 kg",
    cases="8 start phases",
    held_out="another engine",
    baseline="statics, 50 kg",
    holds=True,
    note="3 phases",
)
SLOW = Answer(
    id="R1",
    question="Which way?",
    answer="straight on",
    unit="",
    interval=None,
    paper="0 deg",
    cases="10 craters",
    held_out="",
    baseline="",
    refused=2,
    holds=False,
    seconds=7.5,
)


def benchmark(name: str, value: float, goal: float | None, better: str, **others: object) -> Benchmark:
    defaults = {"unit": "1", "against": "rebuilding"}
    return Benchmark(name=name, value=value, goal=goal, better=better, **(defaults | others))


def broken(*_: object) -> None:
    raise RuntimeError("the robot\nis gone")


def quiet(_: str) -> None:
    """Says nothing."""


ANSWERS = {"O4": lambda full: HEAVY, "O5": broken, "R1": lambda full: SLOW}


def test_answers_of_all_applications(capsys: pytest.CaptureFixture[str]) -> None:
    begun: list[str] = []
    heavy, crash, slow = answer_all(registry=ANSWERS, echo=begun.append)
    assert isinstance(heavy, Answer)
    assert heavy.answer == 43.0
    assert heavy.seconds is not None
    assert 0.0 <= heavy.seconds < 1.0
    assert isinstance(crash, Crash)
    assert "RuntimeError" in capsys.readouterr().err
    assert slow == SLOW
    assert begun == ["O4 ...", "O5 ...", "R1 ..."]


def test_an_assertion_in_drake_ends_one_application_only() -> None:
    def assertion(full: bool) -> None:
        raise SystemExit("Failure at multibody_tree.cc: condition 'x' failed.")

    crash, slow = answer_all(registry={"O1": assertion, "R1": lambda full: SLOW}, echo=quiet)
    assert isinstance(crash, Crash)
    assert slow == SLOW


def test_answers_of_some_applications_and_in_full() -> None:
    asked: list[bool] = []

    def ask(full: bool) -> Answer:
        asked.append(full)
        return SLOW

    assert answer_all(["R1"], full=True, registry={"O4": broken, "R1": ask}, echo=quiet) == [SLOW]
    assert asked == [True]


def test_answers_table_shows_what_does_not_hold() -> None:
    answers = answer_all(registry=ANSWERS, echo=quiet)
    lines = answers_table(answers).splitlines()
    assert "43 kg in [43, 44]" in lines[2]
    assert lines[2].endswith("yes")
    assert "RuntimeError: the robot is gone" in lines[3]
    assert lines[3].endswith("NO")
    assert "straight on" in lines[4]
    assert lines[4].endswith("7.5 s  NO")
    assert lines[5:] == [
        "O4: found on 8 start phases; judged on another engine; instead: statics, 50 kg. 3 phases",
        "R1: found on 10 craters; judged on the same; 2 without an answer; instead: no baseline.",
    ]


def test_answers_have_no_more_digits_than_they_may_claim() -> None:
    answer = replace(SLOW, answer=31.937, unit="times", interval=(12.6539, 51.0627))
    assert "31.9 times in [12.7, 51.1]" in answers_table([answer])


@pytest.mark.parametrize(("answer", "code"), [(HEAVY, 0), (SLOW, 1), (broken, 1)])
def test_program_fails_unless_each_row_holds(
    answer: object, code: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(APPLICATIONS, "O1", answer if callable(answer) else lambda full: answer)  # type: ignore[arg-type]
    assert CliRunner().invoke(main, ["O1"]).exit_code == code
    assert len(json.loads((tmp_path / "answers.json").read_text())) == 1


def test_answers_file(tmp_path: Path) -> None:
    answers = answer_all(registry=ANSWERS, echo=quiet)
    write_answers(tmp_path / "answers.json", answers)
    heavy, crash, slow = json.loads((tmp_path / "answers.json").read_text())
    assert tuple(heavy) == FIELDS
    assert [heavy[name] for name in ("cases", "held_out", "baseline", "refused")] == [
        "8 start phases",
        "another engine",
        "statics, 50 kg",
        0,
    ]
    assert (heavy["id"], heavy["answer"], heavy["interval"], heavy["holds"]) == ("O4", 43.0, [43.0, 44.0], True)
    assert crash == dict.fromkeys(heavy) | {"id": "O5", "holds": False}
    assert (slow["answer"], slow["interval"], slow["seconds"]) == ("straight on", None, 7.5)


BENCHES = {
    "fast": lambda: [
        benchmark("fast", 3.0, 2.5, "higher"),
        benchmark("fast_serial", 1.4, None, "higher"),
    ],
    "slow": lambda: benchmark(
        "slow", inf, 1.0, "lower", unit="s", absolute="patience", against="nothing", note="never arrived"
    ),
    "gone": broken,
}


def test_benchmarks() -> None:
    results = benchmark_all(registry=BENCHES, echo=quiet)
    assert [getattr(r, "holds", None) for r in results] == [True, None, False, None]
    lines = results_table(results).splitlines()
    assert lines[2].split() == ["fast", "3", ">=", "2.5", "yes", "rebuilding"]
    assert lines[3].split() == ["fast_serial", "1.4", "rebuilding"]
    assert lines[4].split() == ["slow", "inf", "s", "<=", "1", "NO", "nothing"]
    assert lines[5].split()[:3] == ["gone", "-", "NO"]
    assert lines[6:] == ["slow: never arrived; absolute: patience"]


def test_page_of_benchmarks() -> None:
    lines = results_page(benchmark_all(registry=BENCHES, echo=quiet), only=["fast", "slow"]).splitlines()
    assert "| fast | 3 |  | >= 2.5 | yes | rebuilding |" in lines
    assert "| slow | inf | s | <= 1 | NO | nothing |" in lines
    assert "* slow: never arrived; absolute: patience" in lines
    assert any("ONLY='fast slow'" in line for line in lines)
    assert any(re.match(r"Measured on \d{4}-\d\d-\d\d: \d+ cores of .*drake \d", line) for line in lines)


def test_benchmarks_file(tmp_path: Path) -> None:
    write_results(tmp_path / "results.json", benchmark_all(registry=BENCHES, echo=quiet))
    fast, _, slow, gone = json.loads((tmp_path / "results.json").read_text())
    assert fast == {
        "name": "fast",
        "value": 3.0,
        "unit": "1",
        "goal": 2.5,
        "better": "higher",
        "holds": True,
        "against": "rebuilding",
    }
    assert (slow["value"], slow["holds"]) == (None, False)
    assert (gone["name"], gone["holds"]) == ("gone", False)


@pytest.mark.parametrize(
    ("value", "goal", "better", "holds"),
    [(1.0, 1.0, "lower", True), (1.1, 1.0, "lower", False), (1.0, 1.0, "higher", True), (nan, 1.0, "higher", False)],
)
def test_benchmark_holds(value: float, goal: float, better: str, holds: bool) -> None:
    assert benchmark("b", value, goal, better).holds is holds


def test_benchmark_may_be_stricter_than_its_goal() -> None:
    assert benchmark("b", 50.0, 35.0, "higher", holds=False).holds is False


def test_benchmark_of_an_unknown_direction() -> None:
    with pytest.raises(ValueError, match="one of higher, lower, not 'more'"):
        benchmark("b", 1.0, 1.0, "more")


def test_a_goal_in_a_unit_says_which_limit_it_stands_for() -> None:
    with pytest.raises(ValueError, match="a goal in s depends on the machine"):
        benchmark("b", 1.0, 1.0, "lower", unit="s")
    assert benchmark("b", 1.0, None, "lower", unit="s").holds is None


def test_the_longest_benchmarks_run_only_by_name() -> None:
    registry = {name: lambda: benchmark("b", 1.0, None, "lower") for name in (ONLY_BY_NAME[0], "fast")}
    assert set(ONLY_BY_NAME) <= set(BENCHMARKS)
    assert len(benchmark_all(registry=registry, echo=quiet)) == 1
    assert len(benchmark_all(ONLY_BY_NAME[:1], registry=registry, echo=quiet)) == 1


def test_interleaved_runs_alternate() -> None:
    calls: list[str] = []
    a, b = interleaved(lambda: calls.append("a"), lambda: calls.append("b"), repeats=3)
    assert "".join(calls) == "ab" + "abbaab"
    assert a.shape == b.shape == (3,)


def test_a_slow_outlier_does_not_move_the_ratio() -> None:
    numbers = iter([1.0, 2.0, 2.0, 100.0, 1.0, 2.0])
    a, b = interleaved_values(lambda: next(numbers), lambda: next(numbers), repeats=3, warm_up=0)
    # In turns: a b, b a, a b.
    np.testing.assert_array_equal(a, [1.0, 100.0, 1.0])
    np.testing.assert_array_equal(b, [2.0, 2.0, 2.0])
    assert ratio(a, b) == 0.5


@pytest.mark.slow
def test_import_time_is_measured() -> None:
    rows = {row.name: row for row in import_time(repeats=1, longer=1, warm_up=0)}
    assert rows["import_time"].against == "import pydrake"
    assert rows["import_time"].goal == 1.2
    assert all(0.0 < row.value < 10.0 for row in rows.values())


def test_a_file_that_cannot_be_written_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_json(path, [{"a": np.float64(1.0), "b": np.array([1, 2]), "c": (inf, {"d": np.bool_(True)})}])
    before = path.read_text()
    assert json.loads(before) == [{"a": 1.0, "b": [1, 2], "c": [None, {"d": True}]}]
    with pytest.raises(TypeError):
        write_json(path, [{"a": object()}])
    assert path.read_text() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(("module", "known"), [("vtbdrake_diagrams.answers", APPLICATIONS), ("benchmarks", BENCHMARKS)])
def test_unknown_names_list_the_known_ones(module: str, known: dict[str, str], tmp_path: Path) -> None:
    command = [sys.executable, "-m", module, "nonsense"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 2
    assert f"there is no nonsense; known are: {', '.join(known)}" in result.stderr
    assert result.stdout == ""
