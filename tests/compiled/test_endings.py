"""Systems that end a simulation, and inertial sensors, in compiled Diagrams."""

from __future__ import annotations

from math import inf

import casadi
import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RevoluteJoint, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, DiscreteValues, EventStatus, LeafSystem

from tests.compiled.contact_agreement import step_errors
from tests.compiled.contact_worlds import crater_climber
from vtbdrake.compiled import At, CompiledRollouts, Equations
from vtbdrake.compiled.segmented_rollouts import SegmentedRollouts
from vtbdrake.components.casadi_system import CasadiSystem
from vtbdrake.components.sensors import Imu
from vtbdrake.optimization import Parameter, Problem
from vtbdrake.rollout.compiled_executor import CompiledExecutor
from vtbdrake.rollout.executor import SerialExecutor
from vtbdrake.rollout.quality import Quality
from vtbdrake.state.systems import collect
from vtbdrake_diagrams.space_climber import CraterScenario

PERIOD = 0.1


class Fuse(LeafSystem):
    """Ends the simulation when its input is as large as a limit, or as small as its negative."""

    def __init__(self, limit: float) -> None:
        super().__init__()
        self.limit = limit
        self.DeclareVectorInputPort("u", 1)
        self.DeclareDiscreteState(1)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> EventStatus:
        u = self.get_input_port().Eval(context)[0]
        state.set_value(0, [context.get_discrete_state(0)[0] + 1.0])
        if u >= self.limit:
            return EventStatus.ReachedTermination(self, "too large")
        if u <= -self.limit:
            return EventStatus.ReachedTermination(self, "too small")
        return EventStatus.Succeeded()

    def compiled_equations(self, context: Context, varied: frozenset[str]) -> FuseEquations:
        return FuseEquations(self, context, varied)


class FuseEquations(Equations):
    endings = ("too large", "too small")

    def output(self, port: str, at: At) -> casadi.SX:
        raise AssertionError("it has no output port")

    def update(self, at: At) -> dict[int, casadi.SX]:
        return {0: at.state(0) + 1.0}

    def ending(self, at: At) -> casadi.SX:
        u, limit = at.input("u"), self.system.limit
        return casadi.if_else(u >= limit, 1, casadi.if_else(u <= -limit, 2, 0))


def counting(limit: float) -> Diagram:
    """A counter whose step is a parameter, behind a fuse that reads it."""
    builder = DiagramBuilder()
    x, step = casadi.SX.sym("x"), casadi.SX.sym("step")
    count = casadi.Function("count", [x, step], [x + step], ["x", "step"], ["x_next"])
    counter = CasadiSystem(update=count, state={"x": 0.0}, parameters={"step": 1.0}, period=PERIOD)
    builder.AddNamedSystem("counter", counter)
    fuse = builder.AddNamedSystem("fuse", Fuse(limit))
    builder.Connect(counter.get_output_port(), fuse.get_input_port())
    return builder.Build()


@pytest.mark.parametrize(("sample_period", "step"), [(0.25, 1.0), (0.1, 1.0), (0.25, -2.0), (0.5, 0.0)])
def test_a_simulation_ends_when_drakes_does(sample_period: float, step: float) -> None:
    diagram = counting(4.0)
    context = diagram.CreateDefaultContext()
    rollouts = CompiledRollouts(
        diagram,
        collect(diagram),
        context,
        horizon=1.5,
        sample_period=sample_period,
        parameters=["counter.step"],
        outputs=["counter.x"],
        compile=False,
    )
    batch = rollouts({"counter.step": [step, 0.0]})
    counter = diagram.GetSubsystemByName("counter")
    counter.GetMyMutableContextFromRoot(context).get_mutable_numeric_parameter(0).SetFromVector([step])
    simulator = Simulator(diagram, context)
    values, message, end = [], "", inf
    for time in rollouts.times.tolist():
        status = simulator.AdvanceTo(time) if time else simulator.Initialize()
        values.append(counter.GetMyContextFromRoot(context).get_discrete_state(0)[0])
        if not status.succeeded():
            message, end = status.FormatMessage(), context.get_time()
            break
    assert batch.valid.all()
    assert batch.messages == (message, "")
    np.testing.assert_array_equal(batch.ends, [end, inf])
    np.testing.assert_array_equal(batch.counts, [len(values), len(rollouts.times)])
    np.testing.assert_array_equal(batch.outputs["counter.x"][0, : len(values)].ravel(), values)
    assert (end < inf) == (step != 0.0)


def test_segments_refuse_a_simulation_that_may_end() -> None:
    diagram = counting(4.0)
    context = diagram.CreateDefaultContext()
    rollouts = CompiledRollouts(
        diagram, collect(diagram), context, horizon=1.0, sample_period=0.5, outputs=["counter.x"], compile=False
    )
    with pytest.raises(ValueError, match="fuse ends the simulation"):
        SegmentedRollouts(rollouts, rollouts.times, every=1, t0=0.0)


@pytest.mark.parametrize("is_free", [True, False])
def test_an_imu_is_the_sensor_itself(is_free: bool) -> None:
    """The comparison with Drake's steps is part of the compilation."""
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", MultibodyPlant(0.01))
    body = plant.AddRigidBody("body", SpatialInertia.SolidBoxWithMass(2.0, 0.1, 0.2, 0.3))
    if not is_free:
        plant.AddJoint(RevoluteJoint("hinge", plant.world_frame(), body.body_frame(), [0.6, 0.0, 0.8]))
    plant.Finalize()
    imu = builder.AddNamedSystem("imu", Imu(plant, body.body_frame(), period=0.02))
    for k in range(imu.num_input_ports()):
        builder.Connect(plant.GetOutputPort(imu.get_input_port(k).get_name()), imu.get_input_port(k))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    plant.SetVelocities(own, np.linspace(0.5, 2.0, plant.num_velocities()))
    sensor = imu.GetMyMutableContextFromRoot(context)
    sensor.get_mutable_numeric_parameter(int(imu.settings.index)).SetFromVector([0.1, -0.2, 0.3, 0.4, 0.5, -2.0])
    rollouts = CompiledRollouts(
        diagram, collect(diagram), context, horizon=0.3, sample_period=0.1, outputs=["imu.imu"], compile=False
    )
    assert np.abs(rollouts().outputs["imu.imu"][0, -1]).min() > 1e-3


@pytest.mark.slow
def test_steps_of_the_climber_in_a_crater_are_drakes() -> None:
    """Its DPS and its sensors are compared when it is compiled."""
    world = crater_climber("sap")
    errors = step_errors(world, 60)
    assert np.median(errors) < 1e-7
    assert errors.max() < 1e-3


@pytest.mark.slow
def test_a_rollout_that_a_system_ends_is_drakes() -> None:
    """A robot that stands makes no progress: it is stuck after its patience, two checks."""
    scenario = CraterScenario(patience=0.8).mental()
    problem = Problem(
        scenario=scenario,
        parameters=[Parameter("u.walk", 0.0, 1.0)],
        quality=Quality(lambda z: max(z, 0.0), of="sim.sys.climber.base.height"),
        horizon=3.0,
        sample_period=0.5,
    )
    pose = [0.0, 0.0, 0.199, 0.0, 0.0, 0.0]  # By default, its feet begin exactly on the ground.
    points = [{"u.walk": 0.0, "sim.sys.climber.base.pose": pose}]
    (compiled,) = (result for _, result in CompiledExecutor(problem.testbed).run(problem.task, points))
    (drakes,) = (result for _, result in SerialExecutor(problem.testbed).run(problem.task, points))
    assert compiled.computed == "compiled"
    assert compiled.end == drakes.end == "terminated"
    assert compiled.message == drakes.message
    np.testing.assert_allclose(compiled.times, drakes.times, atol=1e-12)
    np.testing.assert_allclose(compiled.quality, drakes.quality, atol=1e-6)
