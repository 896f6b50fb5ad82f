"""Beliefs: mental rollouts begin where the DPS believes itself and its world to be."""

import pickle
from dataclasses import dataclass, replace

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import BasicVector

from tests.testbeds import PENDULUM, AcrobotScenario, PendulumScenario
from vtbdrake.components.sensors import JointEncoders
from vtbdrake.components.sensors.errors import ErrorModel
from vtbdrake.reasoning import Belief, BeliefError, BeliefToStart
from vtbdrake.rollout import ProcessExecutor, RolloutRunner, RolloutTask, SerialExecutor, ThreadExecutor
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.testbed import DpsAlone, Interface, Scenario, Signal
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.space_climber import SpaceClimberScenario

THETA, OMEGA = "sim.sys.Pendulum.theta.position", "sim.sys.Pendulum.theta.velocity"
ARM_MASS = "sim.sys.Pendulum.arm.mass"
T = 0.02


class Tracker(AddressedSystem):
    """Estimates angle and rate from the last two angles, and commands no torque.

    .. pydrake_system::

        name: Tracker
        input_ports:
        - angle
        output_ports:
        - torque
    """

    def __init__(self) -> None:
        super().__init__()
        self._estimate = self.declare_discrete_state(angle=Quantity(unit="rad"), rate=Quantity(unit="rad/s"))
        torque = self.DeclareDiscreteState(1)
        self._angle = self.DeclareVectorInputPort("angle", BasicVector(1))
        self.DeclareStateOutputPort("torque", torque)
        self.DeclarePeriodicDiscreteUpdateEvent(T, 0.0, self._update)

    def _update(self, context, discrete):
        (angle,) = self._angle.Eval(context)
        estimate = self._estimate.mutable(discrete)
        estimate.angle, estimate.rate = angle, (angle - estimate.angle) / T


@dataclass
class TrackedScenario(Scenario):
    """A swinging pendulum whose encoder is late, and a DPS that tracks it."""

    latency: int = 3
    time_step: float = 0.001
    gain_of_rate: float = 1.0
    present: bool = False

    def interface(self):
        return Interface(sense=[Signal("angle", size=1)], act=[Signal("torque", size=1, idle=0.0)])

    def make_dps(self):
        return Tracker()

    def add_world(self, builder):
        plant, _ = builder.add_plant(MultibodyPlantConfig(time_step=self.time_step))
        Parser(plant).AddModelsFromUrl(PENDULUM)
        joint = plant.GetJointByName("theta")
        joint.set_position_limits([-2.0], [2.0])
        plant.Finalize()
        builder.add_sensor("angle", JointEncoders(plant, [joint], period=T, errors=ErrorModel(latency=self.latency)))
        builder.sim_actuator("torque", plant.get_actuation_input_port())
        if self.present:
            of, age = ["dps.angle", "dps.rate"], (1 + self.latency) * T
            builder.believe(THETA, of=of, by=lambda angle, rate, *, late: angle + late * rate, age=age, period=T)
        else:
            builder.believe(THETA, of=["dps.angle"])
        builder.believe(OMEGA, of=["dps.rate"], by=lambda rate: self.gain_of_rate * rate)


def _swinging(scenario, seconds=0.63):
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.write(context, {THETA: 1.0})
    simulator = testbed.simulator(context)
    simulator.AdvanceTo(seconds)
    return testbed, simulator.get_context()


@pytest.fixture(scope="module")
def tracked():
    """A testbed, its context after a while, and a mental testbed."""
    return *_swinging(TrackedScenario()), TrackedScenario().build()


def _future(task, testbed, simulator, address):
    context = simulator.get_mutable_context()
    found = [testbed.read(context, address)]
    for instant in task.instants(context.get_time(), testbed.event_timings())[1:]:
        simulator.AdvanceTo(instant)
        found.append(testbed.read(context, address))
    return np.array(found)


# -- perfect beliefs


@pytest.mark.slow_cases
@pytest.mark.parametrize("executor", [SerialExecutor, lambda: ThreadExecutor(2), lambda: ProcessExecutor(2)])
def test_with_a_perfect_belief_the_mental_rollout_is_the_true_future(executor):
    scenario, elbow = AcrobotScenario(time_step=0.01), "sim.sys.Acrobot.elbow.position"
    testbed = scenario.build()
    simulator = testbed.simulator()
    testbed.write(simulator.get_mutable_context(), {elbow: 0.8, "sim.sys.Acrobot.upper_link.mass": 1.2})
    simulator.AdvanceTo(0.51)
    belief = pickle.loads(pickle.dumps(Belief.perfect(testbed, simulator.get_context())))
    task = RolloutTask(scenario.mental(), 0.5, record=[elbow])
    future = _future(task, testbed, simulator, elbow)
    with executor() as workers:
        results = dict(workers.run(task, [{}, {}], start=belief.start(scenario.mental().build())))
    for result in results.values():
        np.testing.assert_array_equal(result.record[elbow], future)


def test_a_perfect_belief_of_a_discrete_walk_is_exact_contacts_included():
    pose = "sim.sys.climber.base.pose"
    scenario = SpaceClimberScenario(
        simulator_config=SimulatorConfig(),
        plant_config=MultibodyPlantConfig(time_step=0.02, contact_model="point", discrete_contact_approximation="sap"),
    )
    testbed = scenario.build()
    simulator = testbed.simulator()
    simulator.AdvanceTo(1.01)
    start = Belief.perfect(testbed, simulator.get_context()).start(scenario.build())
    task = RolloutTask(scenario, 0.5, record=[pose, "sim.sense.foot_contact.foot_contact"], sample_period=0.1)
    found = RolloutRunner(task).run({}, start=start).record
    np.testing.assert_array_equal(found[pose], _future(task, testbed, simulator, pose))
    assert found["sim.sense.foot_contact.foot_contact"].any(axis=1).all(), "a foot is always on the ground"


def test_a_perfect_belief_sets_an_inertia_that_the_mass_would_scale():
    testbed = (scenario := CartPoleScenario()).build()
    context = testbed.default_context()
    mass, inertia = (f"sim.sys.cart_pole.pole.{name}" for name in ("mass", "inertia"))
    expected = testbed.read(context, inertia)
    assert expected.any()
    testbed.write(context, {mass: 2.0 * testbed.read(context, mass)})
    testbed.write(context, {inertia: expected})
    runner = RolloutRunner(RolloutTask(scenario.mental(), T, sample_period=T, record=(mass, inertia)))
    record = runner.run({}, start=Belief.perfect(testbed, context).start(runner.testbed)).record
    assert record[mass][0] == testbed.read(context, mass)
    np.testing.assert_allclose(record[inertia][0], expected, rtol=1e-12)


def test_a_perfect_belief_reaches_a_world_with_another_integrator():
    testbed, context = _swinging(TrackedScenario())
    testbed.write(context, {ARM_MASS: 0.7})
    mental = TrackedScenario(time_step=0.0)
    task = RolloutTask(mental, 0.1, record=[THETA, OMEGA, ARM_MASS, "dps.rate"])
    record = RolloutRunner(task).run({}, start=Belief.perfect(testbed, context).start(mental.build())).record
    for address in task.record:
        assert record[address][0] == testbed.read(context, address)


# -- what a DPS believes


def test_the_mental_world_is_what_the_dps_believes(tracked):
    testbed, context, mental = tracked
    start = Belief.of(testbed, context).start(mental)
    task = RolloutTask(TrackedScenario(), 0.1, record=[THETA, OMEGA, "dps.angle", "time"])
    record = RolloutRunner(task).run({}, start=start).record
    assert (record[THETA][0], record[OMEGA][0]) == (
        testbed.read(context, "dps.angle"),
        testbed.read(context, "dps.rate"),
    )
    assert abs(record[THETA][0] - testbed.read(context, THETA)) > 0.01, "the estimate is late"
    assert (record["dps.angle"][0], record["time"][0]) == (testbed.read(context, "dps.angle"), 0.63)


@pytest.mark.parametrize("latency", [0, 3])
@pytest.mark.parametrize("instant", [0.62, 0.631])
def test_a_rule_leads_its_estimates_to_the_present(latency, instant):
    scenario = TrackedScenario(latency=latency, present=True)
    testbed, context = _swinging(scenario, instant)
    mental, true, rate = scenario.build(), testbed.read(context, THETA), testbed.read(context, "dps.rate")
    start = Belief.of(testbed, context).start(mental)
    (believed,) = start.contents.numbers[mental.start_layout.slice_of(mental.variables()[THETA])]
    # Measured 1 + latency periods before the DPS sampled it, which was at 0.6 or at 0.62 s.
    late = (1 + latency) * T + instant - (0.6 if instant == 0.62 else 0.62)
    assert believed == pytest.approx(testbed.read(context, "dps.angle") + late * rate, abs=1e-9)
    # It falls at up to g / l = 19.62 rad/s^2; the rate belongs to half a period before.
    assert abs(believed - true) < 19.62 * (late**2 + late * T) / 2.0 < abs(late * rate)


def test_the_mental_dps_gets_the_values_that_the_dps_received_last(tracked):
    testbed, context, mental = tracked
    shown = testbed.read(context, "sim.sense.angle.joint_encoders").item()
    task = RolloutTask(TrackedScenario(), 6 * T, record=["dps.angle"], sample_period=T / 2)
    record = RolloutRunner(task).run({}, start=Belief.of(testbed, context).start(mental)).record["dps.angle"]
    # At 0.64 s the value shown, up to 0.70 s those in transit, and then what the sensor itself has measured.
    np.testing.assert_array_equal(record[2:9], shown)
    assert abs(record[-1] - shown) > 0.01


def test_a_belief_shows_what_the_dps_received_and_what_is_believed_of_the_world(tracked):
    testbed, context, _ = tracked
    table = Belief.of(testbed, context)._repr_html_()
    assert "belief at t = " in table and "<td>received</td><td>angle</td>" in table and "<td>world</td>" not in table
    assert "<td>world</td><td>sim." in Belief.perfect(testbed, context)._repr_html_()


def test_a_belief_of_the_dps_alone_gives_the_same_start(tracked):
    testbed, context, mental = tracked
    alone = DpsAlone(TrackedScenario())
    own = alone.continue_from(testbed, context)
    with pytest.raises(BeliefError, match="has not received angle"):
        Belief.of(alone, own).start(mental)
    value = testbed.read(context, "sim.sense.angle.joint_encoders")
    alone.diagram.GetInputPort("real.sense.angle").FixValue(own, value)
    expected, found = Belief.of(testbed, context).start(mental), Belief.of(alone, own).start(mental)
    np.testing.assert_array_equal(found.contents.numbers, expected.contents.numbers)
    assert (found.time, found.contents.names) == (expected.time, expected.contents.names)


def test_the_climber_walks_on_from_the_belief_of_its_dps_alone():
    scenario, pose = SpaceClimberScenario(), "sim.sys.climber.base.pose"
    testbed = scenario.build()
    simulator = testbed.simulator()
    simulator.AdvanceTo(3.01)
    context = simulator.get_context()
    alone = DpsAlone(scenario)
    own = alone.continue_from(testbed, context)
    for signal in scenario.interface().sense:
        alone.diagram.GetInputPort(f"real.sense.{signal.name}").FixValue(
            own, testbed.read(context, f"T_sense.{signal.name}.value")
        )
    mental = scenario.mental().build()
    start = Belief.of(alone, own).start(mental)
    task = RolloutTask(scenario.mental(), 1.2, record=[pose, "sim.sys.climber.base.velocity"], sample_period=0.1)
    runner = RolloutRunner(task, mental)
    found = runner.run({}, start=start).record
    future = _future(task, testbed, simulator, pose)
    estimate = np.linalg.norm((found[pose] - future)[0, :3])
    errors = np.linalg.norm((found[pose] - future)[:, :3], axis=1)
    assert 0.0 < estimate < 0.03
    assert errors.max() < 1.5 * estimate
    assert future[-1, 0] - future[0, 0] > 0.2, "it walks"
    # It walks from the first moment: 0.2 m/s, where a robot at rest stumbles.
    np.testing.assert_allclose(found["sim.sys.climber.base.velocity"][:, 3], 0.2, atol=0.05)


# -- uncertain beliefs


def test_samples_have_the_covariance_that_is_given(tracked):
    testbed, context, mental = tracked
    belief = Belief.of(testbed, context)
    to_start = BeliefToStart(
        mental, uncertainty={THETA: 0.1, OMEGA: lambda w, rng: w + 0.5 * rng.uniform(-1.0, 1.0)}, seed=3
    )
    starts = to_start.starts(belief, samples=400)
    q, v = (mental.start_layout.slice_of(mental.variables()[a]) for a in (THETA, OMEGA))
    drawn = np.array([[s.contents.numbers[q][0], s.contents.numbers[v][0]] for s in starts])
    believed = [testbed.read(context, "dps.angle"), testbed.read(context, "dps.rate")]
    np.testing.assert_allclose(drawn.mean(axis=0), believed, atol=0.05)
    np.testing.assert_allclose(drawn.std(axis=0), [0.1, 0.5 / np.sqrt(3.0)], rtol=0.1)
    again = to_start.starts(belief, samples=2)
    np.testing.assert_array_equal(again[1].contents.numbers, starts[1].contents.numbers)


def test_samples_of_a_perfect_belief_lie_around_the_true_world(tracked):
    testbed, context, mental = tracked
    to_start = BeliefToStart(mental, uncertainty={THETA: 0.1, ARM_MASS: 0.5}, seed=3)
    starts = to_start.starts(Belief.perfect(testbed, context), samples=400)
    runner = RolloutRunner(RolloutTask(mental.scenario, 0.05, record=[THETA, ARM_MASS]))
    begun = [runner.run({}, start=start).record for start in starts[:40]]
    drawn = np.array([[record[THETA][0], record[ARM_MASS][0]] for record in begun])
    truth = [testbed.read(context, address) for address in (THETA, ARM_MASS)]
    np.testing.assert_allclose(drawn.mean(axis=0), truth, atol=3.0 * 0.5 / np.sqrt(40.0))
    np.testing.assert_allclose(drawn.std(axis=0), [0.1, 0.5], rtol=0.4)
    np.testing.assert_allclose([np.std([s.values[THETA] for s in starts])], 0.1, rtol=0.1)


def test_a_covariance_matrix_correlates_the_entries_of_a_variable():
    scenario = SpaceClimberScenario()
    mental, pose = scenario.build(), "sim.sys.climber.base.velocity"
    testbed = scenario.build()
    simulator = testbed.simulator()
    simulator.AdvanceTo(0.1)
    C = 1e-2 * (np.eye(6) + 0.8 * (np.eye(6, k=1) + np.eye(6, k=-1)) / 2)
    starts = BeliefToStart(mental, uncertainty={pose: C}).starts(
        Belief.of(testbed, simulator.get_context()), samples=500
    )
    place = mental.start_layout.slice_of(mental.variables()[pose])
    np.testing.assert_allclose(np.cov([s.contents.numbers[place] for s in starts], rowvar=False), C, atol=3e-3)


def test_an_uncertain_parameter_of_the_world_varies_around_its_value_there(tracked):
    testbed, context, mental = tracked
    starts = BeliefToStart(mental, uncertainty={ARM_MASS: 5.0}).starts(Belief.of(testbed, context), samples=30)
    masses = [float(start.values[ARM_MASS]) for start in starts]
    assert min(masses) == 0.0 and max(masses) > 5.0 and len(set(masses)) > 10
    runner = RolloutRunner(RolloutTask(TrackedScenario(), 0.1, record=[ARM_MASS]), mental)
    heavy = int(np.argmax(masses))
    assert runner.run({}, start=starts[heavy]).record[ARM_MASS][0] == masses[heavy]


def test_samples_of_numbers_that_vary_together_are_worlds_in_their_order(tracked):
    testbed, context, mental = tracked
    com, inertia = (ARM_MASS.replace("mass", name) for name in ("center_of_mass", "inertia"))
    samples = [
        {ARM_MASS: m, f"{com}[2]": -0.5 / m, f"{inertia}[0]": 0.1 * m, f"{inertia}[1]": 0.1 * m} for m in (1.0, 2.0)
    ]
    to_start = BeliefToStart(mental, uncertainty=samples)
    starts = to_start.starts(Belief.of(testbed, context), samples=3)
    assert to_start.uncertain == tuple(sorted((ARM_MASS, com, inertia)))
    runner = RolloutRunner(RolloutTask(TrackedScenario(), 0.1, record=[ARM_MASS, com, inertia]), mental)
    for start, sample in zip(starts, [*samples, samples[0]], strict=True):
        record = runner.run({}, start=start).record
        assert record[ARM_MASS][0] == sample[ARM_MASS]
        assert record[ARM_MASS][0] * record[com][0, 2] == pytest.approx(-0.5)
        assert record[inertia][0, 1] == pytest.approx(sample[f"{inertia}[1]"])


def test_a_certain_belief_has_the_same_start_for_all_samples(tracked):
    testbed, context, mental = tracked
    first, second = BeliefToStart(mental).starts(Belief.of(testbed, context), samples=2)
    assert first is second


@pytest.mark.parametrize(
    ("uncertainty", "why"),
    [
        (0.1, "uncertainty is given by address"),
        ([{"sim.sys.Pendulum.theta.positon": 0.1}], "a sample of the belief does not fit .*did you mean"),
        ([0.1], "or as samples"),
        ({"dps.rate": 0.1}, "unlike dps.rate"),
        ({THETA: -1.0}, "is a standard deviation"),
        ({THETA: [0.1, 0.2]}, "of shape"),
        ({THETA: np.nan}, "is a standard deviation"),
        ({"sim.sys.Pendulum.theta.positon": 0.1}, "did you mean"),
    ],
)
def test_an_uncertainty_that_does_not_fit_is_refused(tracked, uncertainty, why):
    with pytest.raises(ValueError, match=why):
        BeliefToStart(tracked[2], uncertainty=uncertainty)


def test_a_drawn_text_is_no_number(tracked):
    testbed, context, mental = tracked
    to_start = BeliefToStart(mental, uncertainty={OMEGA: lambda w, rng: "0.5"})
    with pytest.raises(ValueError, match=f"what was drawn for {OMEGA} must be a number or several, not '0.5'"):
        to_start.starts(Belief.of(testbed, context), samples=2)


@dataclass
class TextScenario(TrackedScenario):
    """The mass of the arm is believed by a rule that returns a text."""

    def add_world(self, builder):
        super().add_world(builder)
        builder.believe(ARM_MASS, of=["dps.angle"], by=lambda angle: "1.5")


# -- beliefs from which nothing can begin


def test_a_believed_text_is_no_number():
    testbed = TextScenario().build()
    with pytest.raises(BeliefError, match=f"{ARM_MASS} takes numbers of shape .*, but '1.5' is believed"):
        BeliefToStart(testbed).start(Belief.of(testbed, testbed.default_context()))


def test_a_missing_belief_or_one_out_of_bounds_is_refused(tracked):
    testbed, context, _ = tracked
    belief = Belief.of(testbed, context)
    unknown = TrackedScenario(gain_of_rate=np.nan)
    unknown.validate = lambda: None  # A scenario's fields are finite.
    with pytest.raises(BeliefError, match=r"theta.velocity is missing: nan, of \{'dps.rate': "):
        belief.start(unknown.build())


def test_an_estimate_past_a_stop_is_clipped_or_refused(tracked):
    testbed, _, mental = tracked
    context, to_start = testbed.default_context(), BeliefToStart(mental)
    for angle in (2.19, -2.19):
        testbed.write(context, {"dps.angle": angle})
        start = to_start.start(Belief.of(testbed, context))
        assert start.contents.numbers[mental.start_layout.slice_of(mental.variables()[THETA])] == np.sign(angle) * 2.0
    testbed.write(context, {"dps.angle": 2.21})
    with pytest.raises(BeliefError, match=rf"{THETA} is 2.21 rad, .* must lie in \[-2, 2\]"):
        to_start.start(Belief.of(testbed, context))


@dataclass
class WeighedScenario(TrackedScenario):
    """The estimate of the angle is taken for the mass of the arm, too, which has a lower bound alone."""

    def add_world(self, builder):
        super().add_world(builder)
        builder.believe(ARM_MASS, of=["dps.angle"])


def test_an_estimate_beyond_a_bound_without_an_opposite_one_is_refused():
    testbed = WeighedScenario().build()
    context = testbed.default_context()
    testbed.write(context, {"dps.angle": -0.01})
    with pytest.raises(BeliefError, match=r"mass is -0.01 kg, .* must lie in \[0, inf\]"):
        BeliefToStart(testbed).start(Belief.of(testbed, context))


def test_an_old_belief_is_refused(tracked):
    testbed, context, mental = tracked
    belief, to_start = Belief.of(testbed, context), BeliefToStart(mental, max_age=0.1)
    to_start.start(belief, now=0.7)
    with pytest.raises(BeliefError, match=r"of t = 0.63 s and 0.12 s old, but at most 0.1 s"):
        to_start.start(belief, now=0.75)
    with pytest.raises(BeliefError, match="nan s old"):
        to_start.start(belief, now=float("nan"))
    with pytest.raises(BeliefError, match="of t = 0.63 s, which lies after now = 0.5 s"):
        to_start.start(belief, now=0.5)
    with pytest.raises(BeliefError, match=r"older than max_age = 0.1 s depends on now: give now="):
        to_start.start(belief)


def test_a_world_without_rules_is_refused():
    testbed = AcrobotScenario().build()
    with pytest.raises(BeliefError, match="declare them with VirtualTestbedBuilder.believe"):
        Belief.of(testbed, testbed.default_context()).start(testbed)


def test_another_dps_is_refused_by_the_name_of_what_differs(tracked):
    testbed = AcrobotScenario().build()
    with pytest.raises(BeliefError, match=r"it lacks dps/discrete/0 \(2\); it has dps/discrete/0 \(1\)"):
        Belief.of(testbed, testbed.default_context()).start(tracked[2])


def test_the_mental_world_may_differ_where_the_dps_is_the_same(tracked):
    testbed, context, _ = tracked
    other = TrackedScenario(latency=0, time_step=0.0)
    start = Belief.of(testbed, context).start(other.build())
    record = RolloutRunner(RolloutTask(other, 0.1, record=[THETA])).run({}, start=start).record
    assert record[THETA][0] == testbed.read(context, "dps.angle")


def test_what_is_no_belief_is_refused(tracked):
    testbed, context, mental = tracked
    with pytest.raises(BeliefError, match="not Snapshot"):
        BeliefToStart(mental).start(testbed.snapshot(context))
    with pytest.raises(ValueError, match="positive time"):
        BeliefToStart(mental, max_age=0.0)
    belief = Belief.of(testbed, context)
    with pytest.raises(BeliefError, match="has not received angle"):
        BeliefToStart(mental).start(replace(belief, dps=replace(belief.dps, received={})))


@pytest.mark.parametrize("forked", [True, False])
@pytest.mark.parametrize("same_stops", [True, False])
def test_perfect_beliefs_are_the_future_under_error_control_after_a_fork_and_with_the_same_stops(forked, same_stops):
    scenario = PendulumScenario(simulator_config=SimulatorConfig(max_step_size=0.5, accuracy=1e-4))
    theta = "sim.sys.Pendulum.theta.position"
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.write(context, {theta: 0.8})
    simulator = testbed.simulator(context)
    simulator.AdvanceTo(1.13)
    context = simulator.get_mutable_context()
    if forked:
        testbed.fork(simulator)
    task = RolloutTask(scenario, 3.0, record=[theta], sample_period=0.15)
    runner = RolloutRunner(task)
    forecast = runner.run({}, start=Belief.perfect(testbed, context).start(runner.testbed)).record[theta]
    for instant in task.instants(1.13, testbed.event_timings())[1:] if same_stops else [4.13]:
        simulator.AdvanceTo(instant)
    future = testbed.read(context, theta)
    assert (forecast[-1] == future) == (forked and same_stops)
    assert abs(forecast[-1] - future) < 1e-2
