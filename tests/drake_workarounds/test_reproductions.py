"""The smallest reproduction of each fault of Drake that `vtbdrake.drake_workarounds` names.

A reproduction returns whether the installed Drake has the fault. If the oldest supported version has it no more the
test fails, and says which workaround may go; if only a newer one has not, the test is skipped and says so.
"""

from __future__ import annotations

import gc
import pickle
import signal
import subprocess
import sys
import weakref
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pydrake.common
import pytest
from pydrake.common.value import Value
from pydrake.manipulation import SchunkWsgTrajectoryGenerator
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import DoorHingeConfig, FixedOffsetFrame, RevoluteJoint, SpatialInertia
from pydrake.systems.analysis import ApplySimulatorConfig, InitializeParams, Simulator, SimulatorConfig
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import Integrator, PortSwitch

import vtbdrake.drake_workarounds
from tests.testbeds import add_deformable_ball
from vtbdrake.common.drake_version import TESTED_DRAKE

ROOT = Path(__file__).resolve().parents[2]
OLDEST = TESTED_DRAKE[0]
PATIENCE = 120.0  # s, for another process

REPRODUCTIONS: dict[str, list[Callable[[], bool]]] = {}


def reproduces(workaround: str) -> Callable[[Callable[[], bool]], Callable[[], bool]]:
    """Enter a function as a reproduction of what a workaround is for."""

    def enter(function: Callable[[], bool]) -> Callable[[], bool]:
        REPRODUCTIONS.setdefault(workaround, []).append(function)
        return function

    return enter


def run(program: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", program]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE, check=False)


class EndlessError(Exception):
    """The time derivatives were evaluated at one time many more times than a step needs."""


class NotANumber(LeafSystem):
    def __init__(self) -> None:
        super().__init__()
        self.DeclareContinuousState(1)
        self.evaluations = 0

    def DoCalcTimeDerivatives(self, context, derivatives):
        self.evaluations += 1
        if self.evaluations == 10_000:
            raise EndlessError
        derivatives.get_mutable_vector().SetFromVector([np.nan])


@reproduces("drake_workarounds.step_watch")
def integrator_tries_steps_for_ever() -> bool:
    simulator = Simulator(NotANumber())
    ApplySimulatorConfig(SimulatorConfig(integration_scheme="runge_kutta3", use_error_control=True), simulator)
    try:
        simulator.AdvanceTo(1.0)
    except EndlessError:
        return True
    except RuntimeError:
        pass
    return False


class CtrlC:
    """Ctrl-C is pressed while this is made an array."""

    def __array__(self, dtype=None, copy=None):
        signal.raise_signal(signal.SIGINT)
        return np.zeros(1)


@reproduces("drake_workarounds.lost_interrupts")
def conversion_drops_an_interrupt() -> bool:
    try:
        BasicVector(1).SetFromVector(CtrlC())
    except KeyboardInterrupt:
        return False
    except TypeError:
        pass
    return True


# One thread waits in a warning of Drake's for the other one, which comes to the same warning. A thread without Python
# ends a process that is stuck.
TWO_WARNINGS = """
import faulthandler, logging, threading
from pydrake.geometry import HalfSpace
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig, CoulombFriction
from pydrake.systems.framework import DiagramBuilder

def diagram():
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.01), builder)
    plant.RegisterCollisionGeometry(
        plant.world_body(), RigidTransform(), HalfSpace(), "ground", CoulombFriction(1.0, 1.0)
    )
    plant.Finalize()
    return builder.Build()

begun, done = threading.Event(), threading.Event()

class Slow(logging.Handler):
    def emit(self, record):
        begun.set()
        print(record.getMessage(), flush=True)
        done.wait(60.0)

logging.getLogger("drake").addHandler(Slow())
first, second = diagram(), diagram()

def come_second():
    begun.wait(60.0)
    second.CreateDefaultContext()
    done.set()

threading.Thread(target=come_second, daemon=True).start()
faulthandler.dump_traceback_later(3.0, exit=True)
first.CreateDefaultContext()
assert begun.is_set(), "no warning"
print("both are done", flush=True)
"""


@reproduces("drake_workarounds.making")
def threads_wait_for_each_other_in_a_warning() -> bool:
    ended = run(TWO_WARNINGS)
    warning, *rest = ended.stdout.splitlines()
    assert "half spaces are not currently supported" in warning, ended.stderr
    return rest != ["both are done"]


class Ticks(LeafSystem):
    """Counts its periodic updates, of each (period, offset) in s."""

    def __init__(self, *timings: tuple[float, float]) -> None:
        super().__init__()
        self.DeclareDiscreteState(1)
        self.counts = [0] * len(timings)
        for i, (period, offset) in enumerate(timings):
            self.DeclarePeriodicDiscreteUpdateEvent(period, offset, lambda context, discrete, i=i: self._count(i))

    def _count(self, i: int) -> None:
        self.counts[i] += 1


def updates_at(time: float, period: float, offset: float) -> int:
    """Return the number of updates at a time at which a simulation is continued."""
    ticks = Ticks((period, offset))
    context = ticks.CreateDefaultContext()
    context.SetTime(time)
    simulator = Simulator(ticks, context)
    simulator.Initialize(InitializeParams(suppress_initialization_events=True))
    simulator.AdvanceTo(time + period / 2)
    return ticks.counts[0]


@reproduces("drake_workarounds.event_times")
def event_at_the_begin_is_skipped() -> bool:
    assert updates_at(0.03 + 2 * 0.1, 0.1, 0.03) == 1
    return updates_at(0.03 + 3 * 0.1, 0.1, 0.03) == 0


@reproduces("drake_workarounds.event_times")
def event_just_after_another_is_skipped() -> bool:
    ticks = Ticks((0.1, 0.7), (0.1, 0.0))
    Simulator(ticks).AdvanceTo(0.7 + 10.05)
    return ticks.counts[0] < 101


def pendulum(**config: object) -> Simulator:
    """Return the simulator of a pendulum, whose centre is 1 m from its joint, in CENIC's integration."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.0), builder)
    plant.set_name("plant")
    body = plant.AddRigidBody("body", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    top = plant.AddFrame(FixedOffsetFrame("top", body.body_frame(), RigidTransform([0.0, 0.0, 1.0])))
    plant.AddJoint(RevoluteJoint("joint", plant.world_frame(), top, [0, 1, 0]))
    plant.Finalize()
    simulator = Simulator(builder.Build())
    ApplySimulatorConfig(SimulatorConfig(integration_scheme="cenic", **config), simulator)
    return simulator


@reproduces("drake_workarounds.cenic")
def step_of_length_zero_fails() -> bool:
    simulator = pendulum(accuracy=1e-3, use_error_control=True)
    simulator.Initialize()
    try:
        simulator.AdvanceTo(0.0)
    except SystemExit:
        return True
    return False


@reproduces("drake_workarounds.cenic")
def poses_are_those_before_a_fixed_step() -> bool:
    simulator = pendulum(max_step_size=0.02, use_error_control=False)
    plant = simulator.get_system().GetSubsystemByName("plant")
    joint, body = plant.GetJointByName("joint"), plant.GetBodyByName("body")
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    joint.set_angle(context, 1.0)
    simulator.AdvanceTo(0.5)
    height = plant.EvalBodyPoseInWorld(context, body).translation()[2]
    return not np.isclose(height, -np.cos(joint.get_angle(context)), atol=1e-9)


TWO_MESHCATS = """
import threading
from pydrake.geometry import Meshcat
from tests.meshcats import kill_own

killed, other = [Meshcat()], [Meshcat()]
kill_own(killed[0])
try:
    killed[0].port()
except RuntimeError as error:
    print("dead" if "exited unexpectedly" in str(error) else error, flush=True)
thread = threading.Thread(target=other.clear)
thread.start()
thread.join()
print("ended", flush=True)
"""


@reproduces("drake_workarounds.kept_meshcats")
def meshcat_dies_and_ends_the_process() -> bool:
    ended = run(TWO_MESHCATS)
    assert "dead" in ended.stdout or "ended" in ended.stdout, ended.stderr
    return ended.stdout == "dead\n" and ended.returncode == -signal.SIGABRT


@reproduces("drake_workarounds.schunk_wsg")
def gripper_follows_the_ramp_of_another_context() -> bool:
    generator = SchunkWsgTrajectoryGenerator(2, 0)

    def moved_to(position: float) -> Context:
        context = generator.CreateDefaultContext()
        generator.GetInputPort("desired_position").FixValue(context, [position])
        generator.GetInputPort("force_limit").FixValue(context, [40.0])
        generator.get_input_port(2).FixValue(context, [-0.02, 0.0])
        Simulator(generator, context).AdvanceTo(0.12)
        return context

    context = moved_to(0.1)
    copied = context.Clone()
    target = generator.get_output_port(0).Eval(context).copy()
    moved_to(0.0)
    copied.SetTime(np.nextafter(copied.get_time(), np.inf))
    return not np.allclose(generator.get_output_port(0).Eval(copied), target, atol=1e-9)


def is_immortal(kind: type[LeafSystem]) -> bool:
    system = kind()
    reference = weakref.ref(system)
    del system
    gc.collect()
    return reference() is not None


class CallsItsMethod(LeafSystem):
    __slots__ = ()

    def __init__(self) -> None:
        super().__init__()
        self.DeclareVectorOutputPort("y", 1, self.calc)

    def calc(self, context, output):
        output.SetZero()


class WithDict(LeafSystem):
    def __init__(self) -> None:
        super().__init__()
        self.cycle = self


class WithoutDict(LeafSystem):
    __slots__ = ()

    def __init__(self) -> None:
        super().__init__()
        self.cycle = self


@reproduces("state.declarations")
def system_that_an_output_port_calls_is_not_freed() -> bool:
    return is_immortal(CallsItsMethod)


@reproduces("state.declarations")
def system_with_a_dict_of_its_own_is_not_freed() -> bool:
    assert not is_immortal(WithoutDict)
    return is_immortal(WithDict)


@reproduces("testbed.addressed")
def context_that_was_found_in_itself_is_not_freed() -> bool:
    builder = DiagramBuilder()
    builder.AddNamedSystem("integrator", Integrator(1))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    reference = weakref.ref(context)
    assert diagram.GetMyContextFromRoot(context) is context
    del context
    gc.collect()
    return reference() is not None


@reproduces("common.failures")
def failed_assertion_is_no_exception() -> bool:
    # Newer versions begin its name with an underscore.
    (name,) = (name for name in dir(pydrake.common) if name.endswith("trigger_an_assertion_failure"))
    with pytest.raises(BaseException) as raised:
        getattr(pydrake.common, name)()
    return not isinstance(raised.value, Exception)


@reproduces("testbed.scenario")
def config_is_not_pickled() -> bool:
    # No scenario has a config of this class. `vtbdrake.testbed.scenario` registers how its own configs are pickled.
    try:
        pickle.dumps(DoorHingeConfig())
    except TypeError:
        return True
    return False


@reproduces("common.pickling")
def metaclass_is_not_pickled() -> bool:
    try:
        pickle.dumps(type(LeafSystem))
    except pickle.PicklingError:
        return True
    return False


@reproduces("common.pickling")
def function_is_not_pickled() -> bool:
    try:
        pickle.dumps(AddMultibodyPlant)
    except (TypeError, pickle.PicklingError):
        return True
    return False


@reproduces("testing.checks.repetition_checks")
def reset_leaves_deformable_bodies_as_they_are() -> bool:
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.01), builder)
    add_deformable_ball(plant)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    start = context.get_discrete_state(1).value().copy()
    context.SetDiscreteState(1, start + 0.1)
    plant.SetDefaultContext(context)
    return not np.array_equal(context.get_discrete_state(1).value(), start)


@reproduces("testbed.switch")
def switch_is_for_vectors_only() -> bool:
    try:
        PortSwitch(Value(object()))
    except TypeError:
        return True
    return False


# Renders in a thread, and ends the renderer in another one.
RENDERS = """
import threading
from pydrake.geometry import (ClippingRange, ColorRenderCamera, GeometryInstance, MakeRenderEngineVtk,
                              PerceptionProperties, RenderCameraCore, RenderEngineVtkParams, SceneGraph, Sphere)
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraInfo
from vtbdrake.drake_workarounds.renderer_threads import release_renderers
scene_graph = SceneGraph()
scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(RenderEngineVtkParams(backend="EGL")))
ball = GeometryInstance(RigidTransform([0.0, 0.0, 1.0]), Sphere(0.1), "ball")
ball.set_perception_properties(PerceptionProperties())
scene_graph.RegisterAnchoredGeometry(scene_graph.RegisterSource("world"), ball)
core = RenderCameraCore("vtk", CameraInfo(16, 16, 1.0), ClippingRange(0.1, 10.0), RigidTransform())
contexts = [scene_graph.CreateDefaultContext()]
def render():
    query = scene_graph.get_query_output_port().Eval(contexts[0])
    query.RenderColorImage(ColorRenderCamera(core, False), scene_graph.world_frame_id(), RigidTransform())
    del query
    {last}
thread = threading.Thread(target=render)
thread.start()
thread.join()
contexts.clear()
del scene_graph
"""


@reproduces("drake_workarounds.renderer_threads")
def renderer_is_not_ended_by_another_thread() -> bool:
    return "Unable to eglMakeCurrent" in run(RENDERS.format(last="pass")).stderr


CASES = [
    pytest.param(workaround, function, id=function.__name__)
    for workaround, functions in REPRODUCTIONS.items()
    for function in functions
]


@pytest.mark.parametrize(("workaround", "has_fault"), CASES)
def test_workaround_is_still_needed(workaround: str, has_fault: Callable[[], bool]) -> None:
    if has_fault():
        return
    drake = version("drake")
    if drake.split(".")[:2] == OLDEST.split(".")[:2]:
        pytest.fail(f"Drake {drake} has no such fault any more: the workaround in vtbdrake.{workaround} may go")
    pytest.skip(f"Drake {drake} has no such fault: vtbdrake.{workaround} may go with Drake {OLDEST}")


def test_each_workaround_has_a_reproduction() -> None:
    folder = Path(vtbdrake.drake_workarounds.__file__).parent
    modules = {f"drake_workarounds.{path.stem}" for path in folder.glob("*.py") if path.stem != "__init__"}
    assert modules == {name for name in REPRODUCTIONS if name.startswith("drake_workarounds.")}


def test_each_workaround_is_in_the_list_of_the_folder() -> None:
    text = vtbdrake.drake_workarounds.__doc__ or ""
    names = [name.removeprefix("drake_workarounds.") for name in REPRODUCTIONS]
    assert [name for name in names if name not in text and name.split(".")[-1] not in text] == []


def test_renderer_is_ended_by_another_thread_once_it_is_released() -> None:
    ended = run(RENDERS.format(last="release_renderers()"))
    assert (ended.returncode, ended.stderr) == (0, "")
