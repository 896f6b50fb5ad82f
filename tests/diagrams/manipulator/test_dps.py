"""The DPS alone: its interface, and each law against its equation and Drake's model of the arm."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.analysis import Simulator
from pydrake.systems.controllers import InverseDynamicsController
from pydrake.systems.framework import Context, Diagram

from vtbdrake.state import Variables, collect
from vtbdrake_diagrams.manipulator.arm import GRAVITY, Arm
from vtbdrake_diagrams.manipulator.dps import SENSOR_SIGNALS, make_dps
from vtbdrake_diagrams.manipulator.laws import LAWS
from vtbdrake_diagrams.manipulator.motions import Motion
from vtbdrake_diagrams.manipulator.world import add_arm

T = 0.001
ARM = Arm()
HOME = np.array(ARM.home)
REACH = 2.0 * np.array(ARM.torques) / T  # N m/s: from one end of the range to the other within a period


@pytest.fixture(scope="module")
def plant() -> MultibodyPlant:
    plant = MultibodyPlant(0.0)
    add_arm(plant, ARM)
    plant.Finalize()
    return plant


class Bench:
    """A DPS with signals that are held."""

    def __init__(self, law: str, **parameters: object) -> None:
        self.dps: Diagram = make_dps(law)
        self.simulator = Simulator(self.dps)
        self.context: Context = self.simulator.get_mutable_context()
        self.variables: Variables = collect(self.dps)
        self.variables.write(self.context, {"impl.torque_rate": REACH, **parameters})
        self.period = 0
        self.feed(joint_position=HOME, motion=[1.0])
        for name, size in SENSOR_SIGNALS.items():
            if name != "joint_position":
                self.feed(**{name: np.zeros(size)})

    def feed(self, **signals: object) -> None:
        for name, value in signals.items():
            self.dps.GetInputPort(name).FixValue(self.context, value)

    def step(self, count: int = 1) -> np.ndarray:
        self.period += count
        self.simulator.AdvanceTo(self.period * T)
        return self.dps.get_output_port().Eval(self.context)

    def read(self, address: str) -> np.ndarray:
        return self.variables[address].get(self.context)


def wrench_at_sensor(plant: MultibodyPlant, q: np.ndarray, F_T: np.ndarray) -> np.ndarray:
    """Return what the sensor shows while the environment exerts F_T = [torque; force] on the tip of the arm at rest."""
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    X_WS = plant.GetBodyByName("tool").EvalPoseInWorld(context)
    r_tip = X_WS.rotation().multiply([0, 0, ARM.tool_length])
    r_mass = X_WS.rotation().multiply(ARM.tool_inertia().get_com())
    weight = np.array([0, 0, -ARM.tool_mass * GRAVITY])
    torque = F_T[:3] + np.cross(r_tip, F_T[3:]) + np.cross(r_mass, weight)
    R_SW = X_WS.rotation().matrix().T
    return np.concatenate([R_SW @ torque, R_SW @ (F_T[3:] + weight)])


def model(plant: MultibodyPlant, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gravity's torque (to be held), the tip's Jacobian, rotation and position."""
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    tip, world = plant.GetFrameByName("tip"), plant.world_frame()
    J = plant.CalcJacobianSpatialVelocity(context, JacobianWrtVariable.kV, tip, np.zeros(3), world, world)
    X_WT = tip.CalcPoseInWorld(context)
    return -plant.CalcGravityGeneralizedForces(context), J, X_WT.rotation().matrix(), X_WT.translation()


@pytest.mark.parametrize("law", LAWS)
def test_parts_ports_and_addresses(law: str) -> None:
    dps = make_dps(law)
    assert [system.get_name() for system in dps.GetSystems()] == ["sense", "env", "impl", "act"]
    sizes = {dps.get_input_port(k).get_name(): dps.get_input_port(k).size() for k in range(dps.num_input_ports())}
    assert sizes == {**SENSOR_SIGNALS, "motion": 1}
    assert dps.get_output_port().get_name() == "joint_torque"
    assert not dps.HasAnyDirectFeedthrough()
    addresses = set(collect(dps))
    assert {f"impl.{name}" for name in [*LAWS[law].parameters, *LAWS[law].state, "torque", "motion"]} <= addresses
    for part in ("sense", "env", "impl", "act"):
        assert any(address.startswith(f"{part}.") for address in addresses)


def test_unknown_law_is_refused() -> None:
    with pytest.raises(ValueError, match="joint_impedance, cartesian_impedance, admittance"):
        make_dps("wishful")


@pytest.mark.parametrize("law", LAWS)
def test_at_home_only_gravity_is_held(plant: MultibodyPlant, law: str) -> None:
    bench = Bench(law)
    bench.feed(wrench=wrench_at_sensor(plant, HOME, np.zeros(6)))
    np.testing.assert_allclose(bench.step(3), model(plant, HOME)[0], atol=1e-6)


@pytest.mark.parametrize("law", LAWS)
def test_following_the_arm_only_gravity_is_held(plant: MultibodyPlant, law: str) -> None:
    q = HOME + np.array([0.1, -0.2, 0.3, 0.1, -0.4, 0.2, 0.1])
    bench = Bench(law)
    bench.feed(joint_position=q, motion=[0.0], wrench=wrench_at_sensor(plant, q, np.zeros(6)))
    np.testing.assert_allclose(bench.step(3), model(plant, q)[0], atol=1e-6)


def test_joint_impedance_is_a_spring_and_a_damper_per_joint(plant: MultibodyPlant) -> None:
    dq, v = 0.005 * np.arange(1.0, 8.0), 0.02 * np.array([1, -1, 1, 1, -1, 1, -1])
    K, D = np.arange(100.0, 800.0, 100.0), np.arange(1.0, 8.0)
    bench = Bench("joint_impedance", **{"impl.stiffness": K, "impl.damping": D})
    bench.feed(joint_position=HOME + dq, joint_velocity=v)
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, HOME + dq)
    plant.SetVelocities(context, v)
    bias = plant.CalcBiasTerm(context) - plant.CalcGravityGeneralizedForces(context)
    np.testing.assert_allclose(bench.step(), bias - K * dq - D * v, atol=1e-6)


def test_inverse_dynamics_is_drakes_controller() -> None:
    robot = MultibodyPlant(0.0)
    add_arm(robot, ARM)
    robot.Finalize()
    k_p, k_d = 400.0, 35.0
    controller = InverseDynamicsController(
        robot, np.full(7, k_p), np.zeros(7), np.full(7, k_d), has_reference_acceleration=True
    )
    dq, v = 0.005 * np.arange(1.0, 8.0), 0.02 * np.array([1, -1, 1, 1, -1, 1, -1])
    context = controller.CreateDefaultContext()
    controller.get_input_port_estimated_state().FixValue(context, [*(HOME + dq), *v])
    controller.get_input_port_desired_state().FixValue(context, [*HOME, *np.zeros(7)])
    controller.get_input_port_desired_acceleration().FixValue(context, np.zeros(7))
    bench = Bench("inverse_dynamics", **{"impl.position_gain": k_p, "impl.velocity_gain": k_d})
    bench.feed(joint_position=HOME + dq, joint_velocity=v)
    np.testing.assert_allclose(bench.step(), controller.get_output_port_control().Eval(context), atol=1e-6)


def test_cartesian_impedance_is_a_spring_at_the_tip(plant: MultibodyPlant) -> None:
    """J+' (tau - g) = K e: the joint torques beyond are none that the tip feels."""
    q = HOME + 0.01 * np.array([1, -2, 3, 1, -4, 2, 1])
    K = np.array([50.0, 60.0, 70.0, 1000.0, 1100.0, 1200.0])
    bench = Bench("cartesian_impedance", **{"impl.stiffness": K})
    bench.feed(joint_position=q)
    hold, J, R, p = model(plant, q)
    _, _, R_r, p_r = model(plant, HOME)
    # At small angles, the rotation vector of R_r R'.
    E = R_r @ R.T
    e = np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]]) / 2
    felt = np.linalg.pinv(J).T @ (bench.step() - hold)
    np.testing.assert_allclose(felt, K * np.concatenate([e, p_r - p]), atol=1e-4)


@pytest.mark.slow_cases
@pytest.mark.parametrize("axis", range(6))
def test_admittance_is_a_mass_with_damper_and_spring(plant: MultibodyPlant, axis: int) -> None:
    """The step response against M x'' + D x' + K x = F, solved by the eigenvalues."""
    M, D, K, F = 5.0, 40.0, 300.0, 12.0
    bench = Bench(
        "admittance",
        **{
            "impl.inertia": np.full(6, M),
            "impl.damping": np.full(6, D),
            "impl.stiffness": np.full(6, K),
            "env.wrench_time_constant": 0.0,
        },
    )
    force = np.zeros(6)
    force[axis] = F
    bench.feed(wrench=wrench_at_sensor(plant, HOME, force))
    bench.step(1)  # perceived
    s1, s2 = np.roots([M, D, K])
    for _ in range(10):
        bench.step(50)
        t = (bench.period - 1) * T
        x = F / K * (1 - (s2 * np.exp(s1 * t) - s1 * np.exp(s2 * t)) / (s2 - s1)).real
        offset = bench.read("impl.offset")
        assert offset[axis] == pytest.approx(x, abs=1e-5 * F / K)
        np.testing.assert_allclose(np.delete(offset, axis), 0.0, atol=1e-9)


def test_environment_perceives_the_wrench_at_the_tip(plant: MultibodyPlant) -> None:
    q = HOME + np.array([0.4, -0.2, 0.3, 0.1, -0.4, 0.2, 0.1])
    F = np.array([0.5, -1.0, 0.2, 10.0, -5.0, 20.0])
    bench = Bench("admittance", **{"env.wrench_time_constant": 0.005})
    bench.feed(joint_position=q, wrench=wrench_at_sensor(plant, q, F))
    bench.step(4)
    np.testing.assert_allclose(bench.read("env.contact_wrench"), (1 - np.exp(-4 * T / 0.005)) * F, atol=1e-9)
    np.testing.assert_array_equal(bench.read("env.joint_position"), q)


def test_momentum_observer_finds_the_torque_that_the_sensors_do_not_explain(plant: MultibodyPlant) -> None:
    """At rest, dL/dq = -g: what the sensors feel beyond what holds the links must come from outside."""
    outside = np.array([3.0, -2.0, 1.0, 0.5, -0.5, 0.2, -0.1])
    bench = Bench("joint_impedance")
    bench.feed(joint_torque_measured=model(plant, HOME)[0] - outside)
    k = float(bench.read("env.observer_rate"))
    bench.step(31)
    # What is shown was computed from the integral of 30 periods, of the explicit Euler rule.
    np.testing.assert_allclose(bench.read("env.external_torque"), (1 - (1 - k * T) ** 30) * outside, atol=1e-6)


def test_torque_keeps_rate_and_limits() -> None:
    bench = Bench("joint_impedance", **{"impl.torque_rate": np.full(7, 500.0)})
    last = bench.read("impl.torque")
    bench.feed(joint_position=HOME - 1.0)
    for _ in range(30):
        torque = bench.step()
        assert np.abs(torque - last).max() <= 500.0 * T + 1e-9
        last = torque
    bench.step(2000)
    np.testing.assert_allclose(bench.step()[[5, 6]], [40.0, 40.0])  # 150 and 100 N m are wanted


def test_offsets_calibrate_sensors_and_drives(plant: MultibodyPlant) -> None:
    offset = np.zeros(27)
    offset[:7] = 0.01
    bench = Bench("joint_impedance", **{"sense.offset.value": offset, "act.offset.value": np.full(7, 0.5)})
    bench.feed(joint_position=HOME - 0.01)
    np.testing.assert_allclose(bench.step(), model(plant, HOME)[0] + 0.5, atol=1e-6)


@pytest.mark.slow
def test_the_posture_stays_while_the_tip_goes_round_and_round() -> None:
    """Inverse kinematics alone does not close a redundant arm's circle (Klein, Huang, "Review of Pseudoinverse Control
    for Use with Kinematically Redundant Manipulators", 1983)."""
    bench = Bench("joint_impedance")
    bench.feed(motion=[float(Motion.CIRCLE)])
    bench.step(8)
    postures = []
    for _ in range(2):
        bench.step(5 * 4000)
        postures.append(np.array(bench.read("impl.reference")))
    np.testing.assert_allclose(postures[1], postures[0], atol=2e-3)
    np.testing.assert_allclose(postures[1], HOME, atol=0.1)


@pytest.mark.parametrize("law", LAWS)
def test_measurement_without_value_makes_no_command_of_the_rate_limit(law: str) -> None:
    bench = Bench(law)
    bench.step(10)
    bench.feed(joint_position=np.where(np.arange(7) == 3, np.nan, HOME))
    assert np.isnan(bench.step(2)).any()
