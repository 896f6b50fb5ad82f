"""Other processes import what this one does, whatever it has done to its search path and its current folder since."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

ASK = """
import os, sys
from pathlib import Path
import vtbdrake, mine
os.chdir(sys.argv[1])
{changed}
from vtbdrake.control.worker_process import WorkerProcess
from vtbdrake.lcm.hub import Hub
from vtbdrake.machine import MachineProcess
from vtbdrake.rollout import ProcessExecutor, RolloutTask

import select
def files(worker):
    select.select([worker], [], [])
    frames = worker.take()
    worker.close()
    return frames

print(files(WorkerProcess(mine.tell, name="a worker")))
task = RolloutTask(scenario=mine.PendulumScenario(), horizon=0.1)
with ProcessExecutor(1) as executor:
    ((_, result),) = executor.run(task, [{{}}])
    print(result.end)
with Hub(port=0) as hub, MachineProcess(mine.ServoMachineScenario(), hub.url) as machine:
    print(machine.status().time >= 0.0)
"""

MINE = """
import vtbdrake
from tests.testbeds import PendulumScenario as Pendulum
from tests.control.servo_machine import ServoMachineScenario as Servo
class PendulumScenario(Pendulum): pass
class ServoMachineScenario(Servo): pass
def tell(channel): channel.send(vtbdrake.__file__.encode())
"""


def answers(tmp_path: Path, changed: str = "", twice: Sequence[str] = ("vtbdrake", "mine")) -> list[str]:
    """What a program says that begins in folder a, with its vtbdrake and its modules, and goes to b.

    Args:
        changed: what it does there before it starts other processes.
        twice: modules that b has, too; they cannot be imported.
    """
    folder, other = tmp_path / "a", tmp_path / "b"
    folder.mkdir()
    for name in ("vtbdrake", "tests"):
        (folder / name).symlink_to(ROOT / name)
    (folder / "mine.py").write_text(MINE)
    for name in twice:
        (other / name).mkdir(parents=True)
        (other / name / "__init__.py").write_text("raise ImportError('of another checkout')\n")
    program = ASK.format(changed=changed)
    run = subprocess.run(
        [sys.executable, "-c", program, str(other)], cwd=folder, env={}, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    return run.stdout.splitlines()


def expected(tmp_path: Path) -> list[str]:
    return [str([str(tmp_path / "a/vtbdrake/__init__.py").encode()]), "horizon", "True"]


def test_after_a_change_of_the_current_folder(tmp_path: Path) -> None:
    assert answers(tmp_path) == expected(tmp_path)


def test_another_vtbdrake_that_comes_first_by_now_is_not_used(tmp_path: Path) -> None:
    assert answers(tmp_path, "sys.path.insert(0, sys.argv[1])", ["vtbdrake"]) == expected(tmp_path)


def test_entries_that_are_no_text_are_left_out(tmp_path: Path) -> None:
    assert answers(tmp_path, "sys.path.insert(0, Path(sys.argv[1]))") == expected(tmp_path)
