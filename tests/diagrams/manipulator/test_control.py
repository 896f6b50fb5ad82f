"""The whole testbed: the arm under each law, against the laws' predictions and the laws of mechanics.

Without Coulomb friction where statics are looked at: an arm at rest under it stops anywhere near its equilibrium.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.framework import Context

from vtbdrake.testbed import VirtualTestbed
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.manipulator.arm import GRAVITY, JOINT_NAMES, Arm
from vtbdrake_diagrams.manipulator.laws import LAWS
from vtbdrake_diagrams.manipulator.motions import Motion

T = 0.001
FIRST_LAW, *FURTHER_LAWS = LAWS
ARM = Arm()
SMOOTH = {"sim.act.drives.coulomb": np.zeros(7)}


@cache
def built(law: str) -> VirtualTestbed:
    return ManipulatorScenario(law=law).build()


class Run:
    """One simulation of a testbed."""

    def __init__(self, testbed: VirtualTestbed, motion: int = Motion.HOME, **values: object) -> None:
        self.testbed = testbed
        self.context: Context = testbed.default_context()
        testbed.write(self.context, {"u.motion": float(motion), **values})
        self.simulator = testbed.simulator(self.context)
        self.plant = testbed.plant
        assert self.plant is not None
        self.plant_context = self.plant.GetMyContextFromRoot(self.context)

    def advance(self, seconds: float) -> None:
        self.simulator.AdvanceTo(seconds)

    def read(self, address: str) -> np.ndarray:
        return np.array(self.testbed.read(self.context, address))

    @property
    def q(self) -> np.ndarray:
        return self.plant.GetPositions(self.plant_context)

    @property
    def tip(self) -> np.ndarray:
        return self.tip_at(self.q)

    def tip_at(self, q: np.ndarray) -> np.ndarray:
        context = self.plant.CreateDefaultContext()
        self.plant.SetPositions(context, q)
        return self.plant.GetFrameByName("tip").CalcPoseInWorld(context).translation()

    @property
    def jacobian(self) -> np.ndarray:
        """Errors of the tip's [w; v]."""
        tip, world = self.plant.GetFrameByName("tip"), self.plant.world_frame()
        return self.plant.CalcJacobianSpatialVelocity(
            self.plant_context, JacobianWrtVariable.kV, tip, np.zeros(3), world, world
        )


def profile(x: float) -> float:
    return x**3 * (10 - 15 * x + 6 * x**2)


def wanted_tip(run: Run, motion: int, t: float) -> np.ndarray:
    """Where the tip should be, from the definition of the motions."""
    home = np.array(ARM.home)
    if motion == Motion.SWING:
        return run.tip_at(home + run.read("dps.impl.swing") * profile(t / 2.5))
    angle = 2 * np.pi * profile(t / 4.0)
    return run.tip_at(home) + 0.1 * np.array([0.0, np.sin(angle), 1 - np.cos(angle)])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "motion", "tolerance"),
    [
        ("joint_impedance", Motion.SWING, 0.002),
        ("cartesian_impedance", Motion.CIRCLE, 0.006),
        ("joint_impedance", Motion.CIRCLE, 0.002),
        ("cartesian_impedance", Motion.SWING, 0.006),
        ("admittance", Motion.SWING, 0.002),
        ("admittance", Motion.CIRCLE, 0.002),
    ],
)
def test_motions_are_tracked_in_free_space(law: str, motion: int, tolerance: float) -> None:
    """With friction and current loops that the DPS does not know of, to which a soft law yields more."""
    run = Run(built(law), motion)
    for t in np.arange(1, 12) * 0.2:
        run.advance(t)
        assert np.linalg.norm(run.tip - wanted_tip(run, motion, t)) < tolerance


@pytest.mark.parametrize("law", [FIRST_LAW, *(pytest.param(law, marks=pytest.mark.slow) for law in FURTHER_LAWS)])
def test_without_friction_motions_are_tracked_closely(law: str) -> None:
    run = Run(built(law), Motion.CIRCLE, **SMOOTH, **{"sim.act.drives.viscous": np.zeros(7)})
    for t in np.arange(1, 8) * 0.2:
        run.advance(t)
        assert np.linalg.norm(run.tip - wanted_tip(run, Motion.CIRCLE, t)) < 0.0005


def test_pushed_joint_impedance_yields_by_torque_over_stiffness() -> None:
    run = Run(built("joint_impedance"), **SMOOTH)
    push = np.array([0.0, 2.0, 0.0, 10.0, -15.0, -20.0])
    run.testbed.write(run.context, {"sim.env.push.wrench": push})
    run.advance(2.0)
    expected = run.jacobian.T @ push / run.read("dps.impl.stiffness")
    np.testing.assert_allclose(run.q - ARM.home, expected, atol=1e-5)
    assert np.abs(expected).max() > 0.01


@pytest.mark.slow
def test_pushed_cartesian_impedance_yields_by_force_over_stiffness() -> None:
    run = Run(built("cartesian_impedance"), **SMOOTH)
    force = np.array([30.0, -20.0, 25.0])
    before = run.tip
    run.testbed.write(run.context, {"sim.env.push.wrench": [0, 0, 0, *force]})
    run.advance(3.0)
    np.testing.assert_allclose(run.tip - before, force / run.read("dps.impl.stiffness")[3:], atol=2e-5)


@pytest.mark.slow
def test_pushed_admittance_moves_like_its_mass_damper_and_spring() -> None:
    run = Run(built("admittance"), **SMOOTH)
    run.advance(0.2)  # the first readings of sensors have passed
    before = run.tip
    force, axis = 15.0, 1
    run.testbed.write(run.context, {"sim.env.push.wrench": [0, 0, 0, 0, force, 0]})
    M, D, K = (float(run.read(f"dps.impl.{name}")[3 + axis]) for name in ("inertia", "damping", "stiffness"))
    s1, s2 = np.roots([M, D, K])
    for t in np.arange(1, 9) * 0.1:
        run.advance(0.2 + t)
        x = force / K * (1 - (s2 * np.exp(s1 * t) - s1 * np.exp(s2 * t)) / (s2 - s1)).real
        moved = run.tip - before
        # The wrench is sensed, filtered and turned into torque some 5 ms later.
        assert moved[axis] == pytest.approx(x, abs=0.04 * force / K)
        assert np.abs(np.delete(moved, axis)).max() < 0.04 * force / K
    run.advance(2.5)
    np.testing.assert_allclose((run.tip - before)[axis], force / K, rtol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["cartesian_impedance", "admittance"])
def test_force_on_the_wall_is_that_of_two_springs_in_series(law: str) -> None:
    scenario = ManipulatorScenario(law=law, wall=True)
    run = Run(scenario.build(), Motion.PRESS, **SMOOTH)
    start = run.tip
    gap = scenario.wall_distance - ARM.ball_radius - start[0]
    run.advance(3.0)  # the tip waits from 2 s to 4 s
    k_law, k_wall = run.read("dps.impl.stiffness")[3], scenario.wall_stiffness
    expected = k_law * k_wall / (k_law + k_wall) * (run.read("dps.impl.press_depth") - gap)
    assert expected > 15.0
    F = run.read("dps.env.contact_wrench")[3:]
    assert F[0] == pytest.approx(-expected, rel=2e-3)
    assert run.tip[0] - start[0] - gap == pytest.approx(expected / k_wall, rel=5e-3)
    # The wall is felt in the joints too.
    outside = run.jacobian[3:].T @ F
    np.testing.assert_allclose(run.read("dps.env.external_torque"), outside, atol=0.02 * np.abs(outside).max())


@pytest.mark.slow_cases
@pytest.mark.parametrize("turn", [[0.0] * 7, [0.3, -0.2, 0.5, 0.4, -0.8, 0.6, 1.0]])
def test_resting_arm_senses_its_tools_weight_and_no_contact(turn: list[float]) -> None:
    q = np.array(ARM.home) + turn
    run = Run(built("joint_impedance"))
    positions = {f"sim.sys.arm.{name}.position": value for name, value in zip(JOINT_NAMES, q, strict=True)}
    reference = dict.fromkeys(("dps.impl.start", "dps.impl.reference", "dps.impl.home"), q)
    run.testbed.write(run.context, {**positions, **reference})
    run.advance(1.5)
    wrench = run.read("sim.sense.wrench.wrench")
    assert np.linalg.norm(wrench[3:]) == pytest.approx(ARM.tool_mass * GRAVITY, rel=1e-3)
    np.testing.assert_allclose(run.read("dps.env.contact_wrench"), 0.0, atol=5e-3)
    np.testing.assert_allclose(run.read("dps.env.external_torque"), 0.0, atol=5e-3)


def test_work_of_the_drives_becomes_energy() -> None:
    """Kinetic (also the rotors') and potential energy against the integral of torque times velocity."""
    run = Run(built("joint_impedance"), Motion.SWING)

    def energy() -> float:
        v = run.plant.GetVelocities(run.plant_context)
        M = run.plant.CalcMassMatrix(run.plant_context)
        return float(v @ M @ v / 2 + run.plant.CalcPotentialEnergy(run.plant_context))

    before, work = energy(), 0.0
    exchanged = 0.0
    for k in range(1, 1251):
        torque = run.read("sim.act.drives.torque")
        q = run.q
        run.advance(k * T)
        work += float(torque @ (run.q - q))
        exchanged += abs(float(torque @ (run.q - q)))
    assert energy() - before == pytest.approx(work, abs=5e-3 * exchanged)
    assert abs(work) > 1.0


def test_controllers_model_stays_when_the_arm_becomes_heavier() -> None:
    """It sags by the weight that the DPS does not know of, over the stiffness."""
    run = Run(built("joint_impedance"), **SMOOTH)
    run.testbed.write(run.context, {"sim.sys.arm.link_4.mass": ARM.masses[3] + 1.0})
    run.advance(1.5)
    context = run.plant.CreateDefaultContext()
    run.plant.SetPositions(context, run.q)
    J = run.plant.CalcJacobianTranslationalVelocity(
        context,
        JacobianWrtVariable.kV,
        run.plant.GetFrameByName("link_4"),
        run.plant.GetBodyByName("link_4").default_com(),
        run.plant.world_frame(),
        run.plant.world_frame(),
    )
    sag = J.T @ [0.0, 0.0, -GRAVITY] / run.read("dps.impl.stiffness")
    np.testing.assert_allclose(run.q - ARM.home, sag, atol=2e-4)
