"""What a notebook or a script defines travels to workers: functions, scenarios, and systems derived from Drake's."""

import re
import subprocess
import sys
import textwrap
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[2]

CONTROLLER = """
from pydrake.systems.framework import LeafSystem

class MyController(LeafSystem):
    def __init__(self, period):
        super().__init__()
        self._joints = self.DeclareVectorInputPort("joint_state", 4)
        torque = self.DeclareDiscreteState(1)
        self.DeclareStateOutputPort("torque", torque)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context, discrete):
        discrete.set_value(0, [-3.0 * self._joints.Eval(context)[2]])
"""


def _readme_acrobot() -> str:
    """The scenario class that README shows, without what it then does with it."""
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    (block,) = (block for block in blocks if "class Acrobot(" in block)
    return block.partition("testbed = ")[0]


STUDY = """
shoulder = "sim.sys.Acrobot.shoulder.position"
problem = vtb.Problem(
    scenario=Acrobot(), parameters=[vtb.Parameter(shoulder, 0.0, 1.0)], quality=vtb.Quality(abs, shoulder), horizon=0.5
)
study = problem.study("study.db", solver="sobol").run(rollouts=8, progress=False)
alone = problem.study("alone.db", solver="sobol").run(rollouts=8, progress=False, executor="serial")
print([trial.value for trial in study.trials] == [trial.value for trial in alone.trials], len(study.trials))
"""


def test_readmes_acrobot_in_notebook_cells_is_studied_with_the_defaults(tmp_path):
    cells = [nbformat.v4.new_code_cell(text) for text in (CONTROLLER, _readme_acrobot(), STUDY)]
    notebook = nbformat.v4.new_notebook(cells=cells)
    NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(tmp_path)}}).execute()
    printed = "".join(output.get("text", "") for output in cells[-1].outputs if output.get("name") == "stdout")
    assert printed.split() == ["True", "8"]


SCRIPT = """
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from vtbdrake.rollout import FuturesExecutor, ProcessExecutor, Quality, RolloutTask, SerialExecutor

shoulder = "sim.sys.Acrobot.shoulder.position"

class Angle(float):
    '''A value that only this script can make.'''

def executor(kind):
    if kind == "pool":
        return FuturesExecutor(ProcessPoolExecutor(1, mp_context=get_context("spawn")))
    if kind == "dask":
        from vtbdrake.rollout.cluster import DaskExecutor
        return DaskExecutor(sys.argv[2])
    return ProcessExecutor(1)

if __name__ == "__main__":
    task = RolloutTask(Acrobot(), 0.2, Quality(abs, shoulder))
    points = [{shoulder: Angle(0.1)}, {shoulder: Angle(0.7)}]
    expected = dict(SerialExecutor().run(task, points))
    with executor(sys.argv[1]) as there:
        results = dict(there.run(task, points))
    print(all(results[i].identical(expected[i]) and type(results[i].parameters[shoulder]) is Angle for i in (0, 1)))
"""


@pytest.mark.parametrize("kind", ["processes", "pool", "dask"])
def test_a_system_of_the_main_script_runs_in_workers(kind, tmp_path, request):
    script = tmp_path / "script.py"
    script.write_text(CONTROLLER + _readme_acrobot() + textwrap.dedent(SCRIPT))
    more = [request.getfixturevalue("cluster").address] if kind == "dask" else []
    done = subprocess.run(
        [sys.executable, str(script), kind, *more], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert done.stdout.split() == ["True"], done.stderr
