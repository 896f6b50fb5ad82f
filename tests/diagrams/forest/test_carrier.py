"""Tests of the carrier against statics, conservation of energy and the geometry of steering."""

from dataclasses import dataclass

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from vtbdrake_diagrams.forest.world.carrier import Carrier, Wheels, add_carrier, standing_pose
from vtbdrake_diagrams.forest.world.driver import Driver
from vtbdrake_diagrams.forest.world.ground import Ground
from vtbdrake_diagrams.forest.world.routes import strip_roads

FLAT = Ground(relief=0.0, bumps=0.0)
WEIGHT = Carrier().mass * 9.81


@dataclass
class World:
    """A carrier whose controls, speed and curvature, are constant, or a driver's."""

    diagram: Diagram
    plant: MultibodyPlant
    body: RigidBody
    wheels: Wheels

    def simulator(self, velocity: SpatialVelocity | None = None, X_WB: RigidTransform | None = None) -> Simulator:
        simulator = Simulator(self.diagram)
        context = self.plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
        if velocity is not None:
            self.plant.SetVelocities(context, velocity.get_coeffs())
        if X_WB is not None:
            self.plant.SetFloatingBaseBodyPoseInWorldFrame(context, self.body, X_WB)
        return simulator

    def pose(self, simulator: Simulator) -> RigidTransform:
        return self.plant.EvalBodyPoseInWorld(self.plant.GetMyContextFromRoot(simulator.get_context()), self.body)

    def velocity(self, simulator: Simulator) -> SpatialVelocity:
        return self.plant.EvalBodySpatialVelocityInWorld(
            self.plant.GetMyContextFromRoot(simulator.get_context()), self.body
        )

    def loads(self, simulator: Simulator) -> np.ndarray:
        return self.wheels.wheel_loads(self.wheels.GetMyContextFromRoot(simulator.get_context()))


def world(
    *,
    ground: Ground = FLAT,
    controls: tuple[float, float] = (0.0, 0.0),
    route: int | None = None,
    advice: int | None = None,
    laps: int = 100,
    along: float = 0.0,
    time_step: float = 0.01,
) -> World:
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step)
    carrier = Carrier()
    body = add_carrier(plant, carrier, RigidTransform([0.9, 0.0, 2.0]))
    routes = strip_roads(100.0, 100.0)
    place, heading = (50.0, 50.0), 0.3
    if route is not None:
        place, heading = routes[route].position(along), routes[route].heading(along)
    plant.SetDefaultFloatingBaseBodyPose(body, standing_pose(carrier, ground, position=place, heading=heading))
    plant.Finalize()
    wheels = builder.AddSystem(Wheels(plant, body, carrier, ground))
    if route is None:
        source = builder.AddSystem(ConstantVectorSource(list(controls)))
    else:
        source = Driver(
            routes,
            size=plant.num_multibody_states(),
            start=body.floating_positions_start(),
            wheel_base=1.6,
            period=0.02,
            speed=1.0,
            laps=laps,
            route=route,
            along=along,
        )
        builder.AddNamedSystem("driver", source)
        builder.Connect(plant.get_state_output_port(), source.GetInputPort("state"))
        advised = builder.AddSystem(ConstantVectorSource([float(route if advice is None else advice)]))
        builder.Connect(advised.get_output_port(), source.GetInputPort("route"))
    builder.Connect(plant.get_state_output_port(), wheels.GetInputPort("state"))
    builder.Connect(source.get_output_port(), wheels.GetInputPort("controls"))
    builder.Connect(wheels.GetOutputPort("spatial_force"), plant.get_applied_spatial_force_input_port())
    return World(builder.Build(), plant, body, wheels)


def test_springs_carry_the_weight_on_level_ground() -> None:
    standing = world()
    simulator = standing.simulator()
    assert standing.loads(simulator) == pytest.approx(np.full(4, WEIGHT / 4.0))
    simulator.AdvanceTo(1.0)
    # The carrier keeps its initial pose.
    assert standing.pose(simulator).translation() == pytest.approx([50.0, 50.0, 0.0], abs=1e-6)


def test_carrier_comes_to_rest_on_a_slope() -> None:
    """Springs and friction together are the weight; the loads have the moments of the centre of mass."""
    ground = Ground(seed=1, bumps=0.0)
    standing = world(ground=ground)
    simulator = standing.simulator()
    simulator.AdvanceTo(6.0)
    before = standing.pose(simulator)
    simulator.AdvanceTo(8.0)
    assert np.linalg.norm(standing.pose(simulator).translation() - before.translation()) < 1e-4
    assert standing.velocity(simulator).get_coeffs() == pytest.approx(np.zeros(6), abs=1e-4)
    tilt = np.arccos(standing.pose(simulator).rotation().matrix()[2, 2])
    assert tilt > 0.02
    assert standing.loads(simulator).sum() == pytest.approx(WEIGHT * np.cos(tilt), rel=1e-3)
    p_BoBcm = standing.pose(simulator).rotation() @ [0.0, 0.0, Carrier().centre_height]
    arms = standing.pose(simulator).rotation() @ Carrier().p_BoC_B.T
    lever = arms @ (standing.loads(simulator) / WEIGHT)
    assert lever[:2] == pytest.approx(p_BoBcm[:2], abs=0.01)


def test_braked_carrier_loses_energy() -> None:
    standing = world()
    X_WB = RigidTransform(RollPitchYaw(0.05, -0.05, 0.3), [50.0, 50.0, 0.05])
    simulator = standing.simulator(SpatialVelocity([0.1, 0.0, 0.3], [1.0, 0.5, 0.0]), X_WB)
    carrier, energies = Carrier(), []
    for k in range(60):
        simulator.AdvanceTo(0.05 * k)
        context = standing.plant.GetMyContextFromRoot(simulator.get_context())
        loads = standing.loads(simulator)
        springs = (loads**2).sum() / 2.0 / (WEIGHT / 4.0 / carrier.sag)
        energies.append(
            standing.plant.EvalKineticEnergy(context) + standing.plant.EvalPotentialEnergy(context) + springs
        )
    energies = np.array(energies) - energies[-1]
    # Dampers are part of the loads, so that the springs' energy is only nearly right while the body bounces.
    assert (np.diff(energies) < 0.03 * energies[0]).all()
    assert energies[20] < 0.1 * energies[0]
    assert np.abs(energies[40:]).max() < 0.01 * energies[0]


@pytest.mark.slow_cases
@pytest.mark.parametrize("curvature", [0.1, -0.25])
def test_radius_and_slip_of_a_steady_turn(curvature: float) -> None:
    turning = world(controls=(1.0, curvature))
    simulator = turning.simulator()
    simulator.AdvanceTo(6.0)
    V_WB = turning.velocity(simulator)
    R_WB, w = turning.pose(simulator).rotation().matrix(), V_WB.rotational()[2]
    rear = R_WB.T @ V_WB.Shift(R_WB @ [-0.8, 0.0, 0.0]).translational()
    # The rear axle moves on a circle; the wheels drift outwards by a slip angle of some tenths of a degree.
    assert w / rear[0] == pytest.approx(curvature, rel=0.03)
    slip = rear[1] / rear[0]
    lateral = abs(w * rear[0]) / 9.81 / Carrier().cornering
    assert slip * np.sign(curvature) < 0.0
    assert abs(slip) == pytest.approx(lateral, rel=0.3)
    # The body leans outwards until the springs, less the weight's own moment, bear the centrifugal force.
    carrier = Carrier()
    springs = WEIGHT / carrier.sag * (carrier.track / 2.0) ** 2 - WEIGHT * carrier.centre_height
    lean = carrier.mass * w * rear[0] * carrier.centre_height / springs
    assert R_WB[2, 1] == pytest.approx(lean, rel=0.05)


def test_tyres_damp_turning_on_the_spot() -> None:
    """The dampers of the springs have no share in it; without damping, the carrier would turn to and fro."""
    standing = world(time_step=0.002)
    simulator = standing.simulator(SpatialVelocity([0.0, 0.0, 0.02], [0.0, 0.0, 0.0]))
    rates = []
    for time in np.arange(1.0, 1.5, 0.05):
        simulator.AdvanceTo(time)
        rates.append(abs(standing.velocity(simulator).rotational()[2]))
    assert max(rates) < 0.1 * 0.02


@pytest.mark.slow
def test_wheels_run_faster_uphill_than_the_carrier() -> None:
    """The slip of a tyre in steady rolling is the force over the stiffness: slope / cornering."""
    ground = Ground(seed=1, bumps=0.0)
    driving = world(ground=ground, controls=(1.0, 0.0))
    simulator = driving.simulator()
    slips, slopes = [], []
    for time in np.arange(4.0, 16.0, 0.5):
        simulator.AdvanceTo(time)
        R_WB = driving.pose(simulator).rotation().matrix()
        slips.append(1.0 - R_WB[:, 0] @ driving.velocity(simulator).translational())
        slopes.append(R_WB[2, 0])
    assert np.ptp(slopes) > 0.03
    slope, offset = np.polyfit(slopes, slips, 1)
    assert slope == pytest.approx(1.0 / Carrier().cornering, rel=0.25)
    assert abs(offset) < 2e-3


def test_ice_does_not_hold_the_carrier() -> None:
    driving = world(controls=(1.0, 0.0))
    simulator = driving.simulator()
    context = driving.wheels.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    context.get_mutable_numeric_parameter(0).SetAtIndex(0, 0.02)
    simulator.AdvanceTo(2.0)
    # Friction mu accelerates by mu g at most.
    speed = np.linalg.norm(driving.velocity(simulator).translational())
    assert speed == pytest.approx(0.02 * 9.81 * 2.0, rel=0.1)
    # A tyre that slides is deflected no farther than friction can hold it.
    deflections = context.get_discrete_state(1).value().reshape(4, 2)
    stiffness = Carrier().cornering * WEIGHT / 4.0 / Carrier().relaxation_length
    forces = stiffness * np.linalg.norm(deflections, axis=1)
    assert forces == pytest.approx(0.02 * driving.loads(simulator), rel=0.1)


@pytest.mark.parametrize("curvature", [2.0, -2.0])
def test_steering_has_a_stop_and_a_rate(curvature: float) -> None:
    turning = world(controls=(0.5, curvature))
    simulator = turning.simulator()
    context = turning.wheels.GetMyContextFromRoot(simulator.get_context())
    simulator.AdvanceTo(0.405)
    assert context.get_discrete_state(0).value() == pytest.approx([0.205, np.copysign(0.205, curvature)])
    simulator.AdvanceTo(2.0)
    assert context.get_discrete_state(0).value() == pytest.approx([0.5, np.copysign(0.35, curvature)])


def test_half_the_step_gives_the_same_drive() -> None:
    ends = []
    for time_step in (0.01, 0.005):
        driving = world(ground=Ground(seed=2), controls=(1.0, 0.1), time_step=time_step)
        simulator = driving.simulator()
        simulator.AdvanceTo(1.5)
        ends.append(driving.pose(simulator).translation())
    assert np.linalg.norm(ends[0] - ends[1]) < 0.02


@pytest.mark.slow
def test_driver_follows_the_route_on_bumps() -> None:
    driving = world(ground=Ground(seed=3), route=0)
    route = strip_roads(100.0, 100.0)[0]
    simulator = driving.simulator()
    off, tilts = [], []
    for time in range(1, 40):
        simulator.AdvanceTo(float(time))
        off.append(route.distances(driving.pose(simulator).translation()[:2])[0])
        tilts.append(RollPitchYaw(driving.pose(simulator).rotation()).vector()[:2])
    assert max(off) < 0.5
    assert np.degrees(np.std(tilts, axis=0)).min() > 0.5


def test_driver_looks_for_the_route_where_the_rear_axle_is() -> None:
    driving = world(route=0, along=20.0)
    route = strip_roads(100.0, 100.0)[0]
    simulator = driving.simulator()
    driver = driving.diagram.GetSubsystemByName("driver")
    context = driver.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    context.SetDiscreteState(0, [0.0, 60.0, 0.0])
    for time in (0.01, 4.0):
        simulator.AdvanceTo(time)
        rear = driving.pose(simulator) @ np.array([-0.8, 0.0, 0.0])
        assert context.get_discrete_state(0).value()[1] == pytest.approx(route.nearest(rear[:2]), abs=0.25)


def test_driver_stops_after_the_last_lap() -> None:
    length = strip_roads(100.0, 100.0)[0].length
    driving = world(route=0, laps=1, along=length - 3.0)
    simulator = driving.simulator()
    simulator.AdvanceTo(9.0)
    place = driving.pose(simulator).translation()[:2]
    simulator.AdvanceTo(10.0)
    assert driving.pose(simulator).translation()[:2] == pytest.approx(place, abs=1e-3)
    route = strip_roads(100.0, 100.0)[0]
    assert 0.0 < route.nearest(place) < 3.0


@pytest.mark.parametrize(("along", "taken"), [(2.0, 1), (60.0, 0)])
def test_driver_takes_the_advised_route_before_roads_part(along: float, taken: int) -> None:
    driving = world(route=0, advice=1, along=along)
    simulator = driving.simulator()
    simulator.AdvanceTo(0.05)
    driver = driving.diagram.GetSubsystemByName("driver")
    assert driver.GetMyContextFromRoot(simulator.get_context()).get_discrete_state(0).value()[0] == taken


def test_impossible_carriers_are_refused() -> None:
    with pytest.raises(ValueError, match="are positive"):
        Carrier(mass=0.0)
