"""A decision warns if a simulated sensor begins anew, whatever the DPS has received."""

import logging
from dataclasses import dataclass

import numpy as np
import pytest
from pydrake.systems.primitives import LinearSystem, ZeroOrderHold

from vtbdrake.components.sensors import ErrorModel
from vtbdrake.components.sensors.sampled import SampledSensor
from vtbdrake.optimization import Choice
from vtbdrake.reasoning import Belief, Budget, Reasoner, SearchConfig
from vtbdrake.reasoning.unbelieved import UnbelievedReadings
from vtbdrake.rollout import Quality
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.testbed import Interface, Scenario, Signal
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.satellite import SatelliteScenario
from vtbdrake_diagrams.space_climber import SpaceClimberScenario

PERIOD, RADIUS = 0.02, 0.1
CART = "sim.sys.cart.discrete_state_0"


class Encoder(SampledSensor):
    """Measures the angle of the wheel, one period late."""

    def __init__(self) -> None:
        super().__init__("angle", default=[0.0], period=PERIOD, unit="rad", errors=ErrorModel(latency=1))
        self._port = self.DeclareVectorInputPort("angle", 1)

    def _measure(self, context, state):
        return self._port.Eval(context)


class Odometer(AddressedSystem):
    """Counts up the angles of the wheel, and drives at 1 m/s until the cart is at the goal."""

    def __init__(self) -> None:
        super().__init__()
        angle, goal = self.DeclareVectorInputPort("angle", 1), self.DeclareVectorInputPort("goal", 1)
        speed = self.DeclareDiscreteState(1)
        counts = self.declare_discrete_state(place=Quantity(unit="m"), angle=Quantity(unit="rad"))
        self.DeclareStateOutputPort("speed", speed)

        def update(context, state):
            (now,), counted = angle.Eval(context), counts.mutable(state)
            counted.place += RADIUS * (now - counted.angle)
            counted.angle = now
            state.set_value(0, [1.0 if counted.place < goal.Eval(context)[0] else 0.0])

        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, update)


@dataclass
class CartScenario(Scenario):
    """A cart with an encoder at its wheel."""

    believes_wheel: bool = False
    is_late: bool = False
    seen_place: float = 0.0  # rad/m; how much the encoder shows of the place, too

    def interface(self):
        return Interface(
            sense=[Signal("angle", size=1, unit="rad")],
            act=[Signal("speed", size=1, idle=0.0)],
            commands=[Signal("goal", size=1, default=9.0)],
        )

    def make_dps(self):
        return Odometer()

    def add_world(self, builder):
        B, C = PERIOD * np.array([[1.0], [1.0 / RADIUS]]), [[self.seen_place, 1.0]]
        cart = builder.add("sys", "cart", LinearSystem(np.eye(2), B, C, [[0.0]], PERIOD))
        encoder = builder.add("sense", "encoder", Encoder() if self.is_late else ZeroOrderHold(PERIOD, 1))
        builder.connect(cart.get_output_port(), encoder.get_input_port())
        builder.sim_sensor("angle", encoder.get_output_port())
        builder.sim_actuator("speed", cart.get_input_port())
        builder.believe(f"{CART}[0]", of=["dps.place"])
        if self.believes_wheel:
            builder.believe(f"{CART}[1]", of=["dps.angle"])


def _decisions(scenario):
    """Return two decisions, after 2.01 s and 2.21 s: which goal leads to the place 3 m?"""
    testbed = scenario.build()
    simulator = testbed.simulator()
    reasoner = Reasoner(
        scenario=scenario,
        decision=[Choice("u.goal", [2.5, 3.0, 3.5])],
        quality=Quality(lambda x: abs(x[0] - 3.0), CART, reading="end", minimize=True),
        horizon=4.0,
        budget=Budget(rollouts=4),
        search=SearchConfig(method="grid", workers=1),
    )
    with reasoner:
        for t in (2.01, 2.21):
            simulator.AdvanceTo(t)
            yield reasoner.decide(testbed, simulator.get_context())


@pytest.mark.parametrize(("is_late", "last"), [(False, ("19.8 rad", "21.8 rad")), (True, ("19.6 rad", "21.6 rad"))])
def test_an_encoder_that_no_belief_reaches_is_told(is_late, last, caplog):
    first, second = _decisions(CartScenario(is_late=is_late))
    # The DPS of the mental copy takes the step back to 0 rad for 2 m.
    assert first.quality > 0.4
    (warning,) = first.warnings
    assert f"angle[0] begins at 0 rad, but the DPS has received {last[0]} last" in warning
    assert f"declare a belief for {CART}" in warning
    assert last[1] in second.warnings[0]
    assert [record.levelno for record in caplog.records] == [logging.WARNING]  # once


@pytest.mark.parametrize("is_late", [False, True])
def test_with_a_belief_nothing_is_told(is_late, caplog):
    for decision in _decisions(CartScenario(believes_wheel=True, is_late=is_late)):
        assert decision.values == {"u.goal": pytest.approx(3.0)}
        assert decision.quality == pytest.approx(0.0, abs=0.07)
        assert decision.warnings == ()
    assert not caplog.records


def test_a_reading_that_the_belief_reaches_is_not_judged():
    assert next(_decisions(CartScenario(seen_place=0.1))).warnings == ()


@pytest.mark.slow_cases
@pytest.mark.parametrize("scenario", [CartPoleScenario(), SpaceClimberScenario(), SatelliteScenario()], ids=repr)
def test_complete_rules_reach_every_encoder(scenario):
    testbed = scenario.build()
    simulator = testbed.simulator()
    simulator.AdvanceTo(0.2)
    readings = UnbelievedReadings(scenario.mental().build())
    assert readings.warnings(Belief.of(testbed, simulator.get_context())) == ()
