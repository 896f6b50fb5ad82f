"""The DPS alone computes what it computes in its testbed, from where it was there."""

import numpy as np
import pytest

from diagrams.space_climber import SpaceClimberScenario
from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake.testbed import DpsAlone


def closed_loop_then_alone(scenario, start, *, until, more, period):
    """Outputs of the DPS in its testbed, and alone with the same sensor values, from ``until`` periods on."""
    testbed, alone = scenario.build(), DpsAlone(scenario)
    simulator = testbed.simulator()
    testbed.write(simulator.get_mutable_context(), start)
    simulator.AdvanceTo(until * period)
    context = alone.continue_from(testbed, simulator.get_context())
    mine = alone.simulator(context, restored=True)
    pairs = []
    for k in range(1, more + 1):
        root = mine.get_mutable_context()
        for signal in scenario.interface().sense:
            value = testbed.read(simulator.get_context(), f"T_sense.{signal.name}.value")
            alone.diagram.GetInputPort(f"real.sense.{signal.name}").FixValue(root, value)
        simulator.AdvanceTo((until + k) * period)
        mine.AdvanceTo((until + k) * period)
        for signal in scenario.interface().act:
            pairs.append(
                (
                    np.ravel(testbed.read(simulator.get_context(), f"dps.{signal.name}")),
                    alone.read(mine.get_context(), f"real.act.{signal.name}"),
                )
            )
    return pairs


@pytest.mark.parametrize(
    ("scenario", "start"),
    [(AcrobotScenario(), {"sim.sys.Acrobot.shoulder.position": 0.5}), (SpaceClimberScenario(), {"u.heading": 0.2})],
)
def test_the_commands_are_those_of_the_whole_testbed(scenario, start):
    pairs = closed_loop_then_alone(scenario, start, until=40, more=20, period=0.02)
    assert all(np.array_equal(a, b) for a, b in pairs)
    assert len({a.tobytes() for a, _ in pairs}) > 10


def test_it_has_the_boundary_of_the_testbed_and_nothing_of_its_world():
    testbed, alone = SpaceClimberScenario().build(), DpsAlone(SpaceClimberScenario())

    def ports(diagram):
        inputs = [diagram.get_input_port(i).get_name() for i in range(diagram.num_input_ports())]
        return inputs, sorted(diagram.get_output_port(i).get_name() for i in range(diagram.num_output_ports()))

    assert ports(alone.diagram) == ports(testbed.diagram)
    ours = {a for a in testbed.variables() if a.startswith(("dps.", "u.")) or a == "time"}
    assert set(alone.variables()) == ours
    assert np.array_equal(alone.read(alone.default_context(), "real.act.active"), [1.0])


def test_commands_go_with_it():
    testbed, alone = PendulumScenario().build(), DpsAlone(PendulumScenario())
    context = testbed.default_context()
    testbed.write(context, {"u.angle": 0.7})
    assert alone.read(alone.continue_from(testbed, context), "u.angle") == 0.7
