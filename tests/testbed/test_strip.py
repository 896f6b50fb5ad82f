"""The DPS alone computes what it computes in its testbed, from where it was there."""

import numpy as np
import pytest

from diagrams.space_climber import SpaceClimberScenario
from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake.state import Snapshot, SnapshotError
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


def in_the_middle(scenario):
    """The testbed after some steps, and its context."""
    testbed = scenario.build()
    simulator = testbed.simulator()
    testbed.write(simulator.get_mutable_context(), {"u.heading": 0.2})
    simulator.AdvanceTo(0.5)
    return testbed, simulator.get_context()


@pytest.mark.parametrize("through_itself", [False, True])
def test_a_snapshot_does_as_well_as_the_testbed(tmp_path, through_itself):
    testbed, context = in_the_middle(SpaceClimberScenario())
    alone = DpsAlone(SpaceClimberScenario())
    expected = alone.snapshot(alone.continue_from(testbed, context))
    source = expected if through_itself else testbed.snapshot(context)
    source.save(tmp_path / "s")

    restored = alone.default_context()
    assert expected.compare(alone.snapshot(restored))
    alone.restore(restored, Snapshot.load(tmp_path / "s"))
    assert not expected.compare(alone.snapshot(restored))
    assert (restored.get_time(), alone.read(restored, "u.heading")) == (0.5, 0.2)


@pytest.mark.parametrize(
    ("scenario", "difference"),
    [(SpaceClimberScenario(gravity=3.71), "gravity: 1.62 there, 3.71 here"), (PendulumScenario(), "PendulumScenario")],
)
def test_a_snapshot_of_another_scenario_is_refused(scenario, difference):
    testbed = SpaceClimberScenario(gravity=1.62).build()
    snapshot = testbed.snapshot(testbed.default_context())
    alone = DpsAlone(scenario)
    with pytest.raises(SnapshotError, match=difference):
        alone.restore(alone.default_context(), snapshot)


def test_a_snapshot_with_another_dps_is_refused():
    testbed = AcrobotScenario().build()
    whole = testbed.snapshot(testbed.default_context())
    alone = DpsAlone(AcrobotScenario())
    key = next(key for key in whole.groups if key.startswith("dps/"))
    lacking = Snapshot(whole.time, whole.values, {k: v for k, v in whole.groups.items() if k != key})
    with pytest.raises(SnapshotError, match=f"{key} has .* entries in this testbed"):
        alone.restore(alone.default_context(), lacking)
    more = Snapshot(whole.time, whole.values, {**whole.groups, "dps/discrete/7": [0.0]})
    with pytest.raises(SnapshotError, match="has a group dps/discrete/7"):
        alone.restore(alone.default_context(), more)
