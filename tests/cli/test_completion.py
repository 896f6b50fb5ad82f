"""Completion in a shell: bash asks the program itself, which answers without Drake."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.program import ANGLE, PENDULUM, ROOT, error_of, run

pytestmark = pytest.mark.one_python

ROBOTS = "from vtbdrake import Scenario\n\nclass RobotScenario(Scenario):\n    pass\n\nclass Other:\n    pass\n"


def completed(*lines: str, folder: Path) -> list[list[str]]:
    """Return what one bash offers at the end of each line."""
    program = folder / "bin" / "vtbdrake"
    program.parent.mkdir(exist_ok=True)
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m vtbdrake.cli "$@"\n')
    program.chmod(0o755)
    ask = 'COMP_LINE={!r}; COMP_POINT=${{#COMP_LINE}}; _vtbdrake_completion vtbdrake; echo "${{COMPREPLY[@]}}"'
    script = "\n".join(["compopt() { :; }; source <(vtbdrake completion bash)", *map(ask.format, lines)])
    path = f"{program.parent}:{os.environ['PATH']}"
    result = subprocess.run(
        ["bash", "-c", script],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PATH": path},
        capture_output=True,
        text=True,
        check=True,
    )
    assert result.stderr == ""
    return [line.split() for line in result.stdout.splitlines()]


def test_commands_options_and_choices(tmp_path: Path) -> None:
    lines = ("vtbdrake ro", "vtbdrake study ed", "vtbdrake rollout x:Y --hor", "vtbdrake diagram x:Y --mode tw")
    assert completed(*lines, folder=tmp_path) == [["rollout"], ["edit"], ["--horizon"], ["twin"]]


def test_scenarios_of_the_folder_and_of_the_testbeds(tmp_path: Path) -> None:
    (tmp_path / "robots.py").write_text(ROBOTS)
    (tmp_path / "heavy.yaml").write_text("")
    scenarios = completed(
        "vtbdrake rollout robots:",
        "vtbdrake rollout rob",
        "vtbdrake view vtbdrake_diagrams.cart_pole:",
        "vtbdrake rollout robots:RobotScenario@h",
        "vtbdrake view cart_",
        folder=tmp_path,
    )
    # Bash takes a colon for the end of a word.
    assert scenarios == [
        ["RobotScenario"],
        ["robots:RobotScenario"],
        ["CartPoleScenario"],
        ["heavy.yaml"],
        ["cart_pole"],
    ]


def answers(line: str, folder: Path) -> list[str]:
    """Return what the program answers to bash."""
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("_VTBDRAKE_COMPLETE", "bash_complete")
        environment.setenv("COMP_LINE", line)
        result = run(cwd=folder)
    assert result.exit_code == 0
    return result.stdout.split()


def test_parameters_of_a_study_and_files(tmp_path: Path) -> None:
    begin = (PENDULUM, "--horizon", 0.3, "--vary", f"{ANGLE}=-1.5:1.5", "--quality", ANGLE, "--rollouts", 1)
    assert run("study", "run", tmp_path / "a.db", *begin, "--executor", "serial", "--solver", "random").exit_code == 0
    assert answers("vtbdrake study intervene a.db try sim", tmp_path) == [f"plain,{ANGLE}"]
    assert answers("vtbdrake study intervene a.db freeze ", tmp_path) == [f"plain,{ANGLE}"]
    (tmp_path / "gait.yaml").write_text("")
    assert answers("vtbdrake study run a.db ga", tmp_path) == ["plain,gait.yaml"]
    assert answers("vtbdrake study intervene gait.yaml freeze ", tmp_path) == []
    for line in ("rollout x:Y --save ", "view x:Y --start ", "study run ", "export a.lcm "):
        assert answers(f"vtbdrake {line}", tmp_path) == ["file,"]


def test_no_command_needs_drake_to_be_completed() -> None:
    program = (
        "import click, sys\n"
        "from vtbdrake.cli import main\n"
        "def walk(group):\n"
        "    context = click.Context(group)\n"
        "    for name in group.list_commands(context):\n"
        "        command = group.get_command(context, name)\n"
        "        assert not {'pydrake', 'numpy'} & set(sys.modules), name\n"
        "        if isinstance(command, click.Group): walk(command)\n"
        "walk(main)\n"
    )
    subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True)


@pytest.mark.parametrize(("shell", "last"), [("zsh", "1"), ("fish", "roll")])
def test_scripts_of_other_shells_ask_the_program(shell: str, last: str) -> None:
    script = run("completion", shell).stdout
    assert f"_VTBDRAKE_COMPLETE={shell}_complete" in script
    asked = subprocess.run(
        [sys.executable, "-c", "from vtbdrake.cli import main; main(prog_name='vtbdrake')"],
        cwd=ROOT,
        env={
            **os.environ,
            "_VTBDRAKE_COMPLETE": f"{shell}_complete",
            "COMP_WORDS": "vtbdrake roll",
            "COMP_CWORD": last,
        },
        capture_output=True,
        text=True,
        check=True,
    )
    assert "rollout" in asked.stdout


def test_other_shells_are_refused() -> None:
    assert "'bash', 'zsh', 'fish'" in error_of("completion", "tcsh")
