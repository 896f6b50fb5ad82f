"""The program itself: its help, its version, and where it finds scenarios."""

import os
import re
import subprocess
import sys
from pathlib import Path

import click
import pytest

from tests.cli.program import DAMPING, ROOT, error_of, run
from vtbdrake.cli import main


def test_version_is_one_line() -> None:
    program = run("--version")
    assert (program.exit_code, program.stderr) == (0, "")
    assert program.stdout.startswith("vtbdrake")


@pytest.mark.parametrize("command", main.list_commands(click.Context(main)))
def test_help_shows_an_example(command: str) -> None:
    shown = run(command, "--help")
    assert shown.exit_code == 0
    assert f"Example:\n    vtbdrake {command} " in shown.stdout


def test_scenarios_are_found_from_the_current_directory(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("from tests.testbeds import PendulumScenario as Mine\n")
    program = f"import sys; sys.path.remove({str(tmp_path)!r}) if {str(tmp_path)!r} in sys.path else None; "
    program += "sys.path.remove('') if '' in sys.path else None; from vtbdrake.cli import main; main()"
    result = subprocess.run(
        [sys.executable, "-c", program, "variables", "mine:Mine", "--match", "theta.damping"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert DAMPING in result.stdout, result.stderr


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    "command", [["-m", "vtbdrake"], ["-m", "vtbdrake.cli"], ["-P", "-c", "from vtbdrake.cli import main; main()"]]
)
def test_current_directory_is_searched_last(tmp_path: Path, command: list[str]) -> None:
    (tmp_path / "wave.py").write_text("print('has run')\nfrom tests.testbeds import PendulumScenario as Mine\n")
    result = subprocess.run(
        [sys.executable, *command, "variables", "wave:Mine"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert (result.returncode, result.stdout) == (2, "")
    assert "wave has no scenario 'Mine'" in result.stderr


def test_commands_stand_in_groups_each_once() -> None:
    text = run("--help").stdout
    groups = re.findall(r"^(\w+):\n((?:  +\w.*\n)+)", text, re.MULTILINE)
    names = {heading: re.findall(r"^  ([\w-]+)  ", lines, re.MULTILINE) for heading, lines in groups}
    listed = [name for heading in ("Look", "Optimize", "Machine", "Project") for name in names[heading]]
    assert sorted(listed) == main.list_commands(click.Context(main))
    assert {"view", "rollout"} <= {*names["Look"]} and {"run", "hub"} <= {*names["Machine"]}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["veiw", "cart_pole"], "No such command 'veiw'; did you mean view?"),
        (["rolout"], "No such command 'rolout'; did you mean rollout?"),
        (["xyz"], "No such command 'xyz'; the commands are boundary, calibrate, "),
    ],
)
def test_misspelt_command_gets_a_suggestion(arguments: list[str], message: str) -> None:
    assert error_of(*arguments).startswith(f"Error: {message}")


@pytest.mark.parametrize("command", [[], ["study"]])
def test_summaries_of_commands_are_whole(command: list[str]) -> None:
    lines = run(*command, "--help").stdout.splitlines()
    begin = lines.index("Commands:" if command else "Look:")
    summaries = [line for line in lines[begin:] if line.startswith("  ")]
    assert len(summaries) >= 2 and all(line.endswith((".", "?")) for line in summaries)
    assert not any(line.endswith("...") for line in summaries)
