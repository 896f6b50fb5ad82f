"""The cart-pole against Drake's own, against analytic mechanics, and against the plan that it is to follow."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant, MultibodyPlantConfig
from pydrake.systems.analysis import SimulatorConfig
from scipy.interpolate import interp1d

from vtbdrake.components.sensors import ErrorModel
from vtbdrake.deployment import Deployment
from vtbdrake.reasoning import Trajectory
from vtbdrake.testbed import DpsAlone, ScenarioError, VirtualTestbedBuilder, load_scenario
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.cart_pole.dps import PERCEIVED
from vtbdrake_diagrams.cart_pole.model import CART_POLE_SDF, CartPole, cart_pole_sdf

CART, POLE = "sim.sys.cart_pole.cart_slider", "sim.sys.cart_pole.pole_pin"
DRAKES = "package://drake/examples/multibody/cart_pole/cart_pole.sdf"


# Set after the construction, which refuses it.
IMPOSSIBLE = ErrorModel()
IMPOSSIBLE.dropout = 2.0


def continuous() -> CartPoleScenario:
    return CartPoleScenario(
        plant_config=MultibodyPlantConfig(time_step=0.0), simulator_config=SimulatorConfig(accuracy=1e-9)
    )


def test_shipped_file_is_what_the_generator_writes() -> None:
    assert CART_POLE_SDF.read_text() == cart_pole_sdf()


def test_it_moves_as_drakes_own_cart_pole() -> None:
    plants = [MultibodyPlant(0.0), MultibodyPlant(0.0)]
    Parser(plants[0]).AddModels(str(CART_POLE_SDF))
    Parser(plants[1]).AddModelsFromUrl(DRAKES)
    rng = np.random.default_rng(0)
    for _ in range(5):
        state, force = rng.normal(size=4), 10.0 * rng.normal(size=1)
        derivatives = []
        for plant in plants:
            if not plant.is_finalized():
                plant.Finalize()
            context = plant.CreateDefaultContext()
            plant.get_actuation_input_port().FixValue(context, force)
            plant.SetPositionsAndVelocities(context, state)
            derivatives.append(plant.EvalTimeDerivatives(context).CopyToVector())
        np.testing.assert_allclose(*derivatives, rtol=1e-12)


def test_without_force_energy_is_conserved() -> None:
    testbed = continuous().build()
    context = testbed.default_context()
    testbed.write(context, {f"{POLE}.position": 2.5, f"{CART}.velocity": 0.3})
    simulator = testbed.simulator(context)
    energies = []
    for k in range(21):
        simulator.AdvanceTo(0.1 * k)
        q, v = (
            [testbed.read(context, f"{joint}.{part}") for joint in (CART, POLE)] for part in ("position", "velocity")
        )
        energies.append(CartPole().energy(np.array(q), np.array(v)))
    np.testing.assert_allclose(energies, energies[0], atol=1e-6)
    assert np.ptp([q[1], 2.5]) > 0.5


def test_the_hanging_pole_swings_at_its_analytic_frequency() -> None:
    testbed = continuous().build()
    context = testbed.default_context()
    testbed.write(context, {f"{POLE}.position": 1e-3})
    simulator = testbed.simulator(context)
    quarter = np.pi / 2 / CartPole().hanging_frequency
    for k, expected in enumerate([1e-3, 0.0, -1e-3, 0.0, 1e-3]):
        simulator.AdvanceTo(k * quarter)
        assert testbed.read(context, f"{POLE}.position") == pytest.approx(expected, abs=1e-8)


def test_the_force_follows_the_plan_one_sample_later() -> None:
    scenario = CartPoleScenario()
    testbed = scenario.build()
    context = testbed.default_context()
    knots = np.random.default_rng(1).uniform(-60.0, 60.0, size=scenario.knots)
    plan = Trajectory("u.plan", scenario.knots, scenario.duration, scenario.order, lower=-60.0, upper=60.0)
    plan.find(testbed.variables())
    testbed.write(context, {"u.plan": plan.plan(knots, 0.1)})
    simulator = testbed.simulator(context)
    curve = interp1d(np.linspace(0.0, 1.0, scenario.knots), knots, bounds_error=False, fill_value=0.0)
    force = testbed.dps.GetOutputPort("force")
    for k in range(60):
        simulator.AdvanceTo((k + 0.5) * scenario.period)
        found = force.Eval(testbed.dps.GetMyContextFromRoot(context))
        np.testing.assert_allclose(found, curve(round(k * scenario.period - 0.1, 9)), atol=1e-9)


def test_the_force_on_the_cart_is_that_of_the_plan() -> None:
    """Momentum: a constant force F for T seconds on cart and pole, which cannot fall as they accelerate together."""
    scenario = CartPoleScenario(order="zero", knots=1)
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.write(context, {"u.plan": [0.0, 5.0]})
    testbed.simulator(context).AdvanceTo(1.0)
    model = CartPole()
    rate, angle = testbed.read(context, f"{POLE}.velocity"), testbed.read(context, f"{POLE}.position")
    momentum = (model.cart_mass + model.pole_mass) * testbed.read(context, f"{CART}.velocity")
    momentum += model.pole_mass * model.pole_length * rate * np.cos(angle)
    # Discrete steps of 5 ms; the force begins up to a step after the sample.
    assert momentum == pytest.approx(5.0 * 1.0, abs=5.0 * 0.005 + 0.01)


def test_the_belief_is_the_state_of_the_sample_before() -> None:
    scenario = CartPoleScenario()
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.write(context, {f"{POLE}.position": 1.0, f"{CART}.velocity": 0.2})
    simulator = testbed.simulator(context)
    simulator.AdvanceTo(10 * scenario.period)
    names = [f"{joint}.{part}" for part in ("position", "velocity") for joint in (CART, POLE)]
    truth = [testbed.read(context, name) for name in names]
    simulator.AdvanceTo(11.5 * scenario.period)
    np.testing.assert_allclose(testbed.read(context, PERCEIVED), truth, atol=1e-12)
    builder = VirtualTestbedBuilder(scenario.interface())
    scenario.add_world(builder)
    assert {target for belief in builder.belief_rules for target in belief.targets} == set(names)
    assert {belief.age for belief in builder.belief_rules} == {scenario.period}


def test_the_mental_copy_has_the_same_dps_and_a_coarser_world() -> None:
    scenario = CartPoleScenario(position_errors=ErrorModel(noise=1e-3, bias=0.1, latency=1))
    mental = scenario.mental()
    assert mental.plant_config.time_step == scenario.period
    assert mental.position_errors == ErrorModel(bias=0.1, latency=1)
    ours, theirs = DpsAlone(scenario).variables(), DpsAlone(mental).variables()
    assert [(v.address, v.shape) for v in ours.values()] == [(v.address, v.shape) for v in theirs.values()]
    kept = {name: getattr(scenario, name) for name in ("plant_config", "position_errors", "is_mental")}
    assert replace(mental, **kept) == scenario


def test_exact_sensors_of_the_mental_copy_show_the_same() -> None:
    exact = CartPoleScenario().mental()
    perceived = []
    # A latency that can be set later needs our own sensors.
    for scenario in (exact, replace(exact, velocity_errors=ErrorModel(max_latency=1))):
        testbed = scenario.build()
        context = testbed.default_context()
        testbed.write(context, {f"{POLE}.position": 0.5, f"{CART}.velocity": 0.3})
        simulator = testbed.simulator(context)
        for k in range(1, 6):
            simulator.AdvanceTo(k * scenario.period)
            perceived.append(testbed.read(context, PERCEIVED))
    np.testing.assert_array_equal(perceived[:5], perceived[5:])


def test_scenario_comes_back_from_its_file(tmp_path: Path) -> None:
    scenario = CartPoleScenario(force_limit=40.0, order="cubic", velocity_errors=ErrorModel(noise=0.01, seed=3))
    scenario.save(tmp_path / "cart_pole.yaml")
    assert load_scenario(tmp_path / "cart_pole.yaml") == scenario


def test_it_can_run_on_its_machine() -> None:
    assert Deployment.of(CartPoleScenario()).period == CartPoleScenario().period


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"period": 0.0}, "period must be a finite number above 0 s"),
        ({"force_limit": -1.0}, "force_limit must be a finite number above 0 N"),
        ({"order": "quintic"}, "one of zero, linear, cubic, bspline"),
        ({"knots": 1}, "at least 2 knots, not 1"),
        ({"position_errors": IMPOSSIBLE}, "position_errors.dropout must be a number from 0 to 1, not 2.0"),
    ],
)
def test_bad_fields_are_refused(fields: dict, message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        CartPoleScenario(**fields).build()
