"""Tests that what a notebook or a script defines travels to workers: functions, scenarios, systems of their own."""

import subprocess
import sys
import textwrap

import nbformat
import pytest
from nbclient import NotebookClient

ACROBOT = """
from dataclasses import dataclass, field
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlantConfig
import vtbdrake as vtb
from vtbdrake.components.sensors import ErrorModel, JointEncoders
from vtbdrake.state import AddressedSystem, Quantity

class Spring(AddressedSystem):
    def __init__(self):
        super().__init__()
        self.settings = self.declare_parameters(stiffness=Quantity(2.0, "N m/rad", (0.0, 100.0)))     # dps.stiffness
        self.angles = self.DeclareVectorInputPort("joint_position", 2)
        self.DeclareVectorOutputPort("torque", 1, self.calc_torque)

    def calc_torque(self, context, output):
        output.SetFromVector([-self.settings.view(context).stiffness * self.angles.Eval(context)[1]])

@dataclass
class Acrobot(vtb.Scenario):
    plant_config: MultibodyPlantConfig = field(default_factory=lambda: MultibodyPlantConfig(time_step=0.0))
    period: float = 0.02
    errors: ErrorModel = field(default_factory=lambda: ErrorModel(noise=0.001))

    def interface(self):
        return vtb.Interface(
            sense=[vtb.Signal("joint_position", size=2, unit="rad", max_age=0.1)],
            act=[vtb.Signal("torque", size=1, unit="N m", lower=-10, upper=10, idle=0.0)],
        )

    def make_dps(self):
        return Spring()                       # one System, whose ports have the names of the signals

    def add_world(self, builder):
        plant, scene_graph = builder.add_plant(self.plant_config)
        Parser(plant).AddModelsFromUrl("package://drake/examples/acrobot/Acrobot.urdf")
        plant.Finalize()
        joints = [plant.GetJointByName(name) for name in ("shoulder", "elbow")]
        builder.add_sensor("joint_position", JointEncoders(plant, joints, period=self.period, errors=self.errors))
        builder.sim_actuator("torque", plant.get_actuation_input_port())
"""


STUDY = """
shoulder = "sim.sys.Acrobot.shoulder.position"
problem = vtb.Problem(
    scenario=Acrobot(), parameters=[vtb.Parameter(shoulder, 0.0, 1.0)], quality=vtb.Quality(abs, shoulder), horizon=0.5
)
study = problem.study("study.db", solver="sobol").run(rollouts=8, progress=False)
alone = problem.study("alone.db", solver="sobol").run(rollouts=8, progress=False, executor="serial")
print([trial.value for trial in study.trials] == [trial.value for trial in alone.trials], len(study.trials))
"""


@pytest.mark.slow
def test_a_scenario_of_notebook_cells_is_studied_with_the_defaults(tmp_path):
    cells = [nbformat.v4.new_code_cell(text) for text in (ACROBOT, STUDY)]
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


@pytest.mark.parametrize(
    "kind", ["processes", *(pytest.param(name, marks=pytest.mark.slow) for name in ("pool", "dask"))]
)
def test_a_system_of_the_main_script_runs_in_workers(kind, tmp_path, request):
    script = tmp_path / "script.py"
    script.write_text(ACROBOT + textwrap.dedent(SCRIPT))
    more = [request.getfixturevalue("cluster").address] if kind == "dask" else []
    done = subprocess.run(
        [sys.executable, str(script), kind, *more], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert done.stdout.split() == ["True"], done.stderr
