"""A slow part that samples the state of the whole DPS, and one that works on request."""

import gc
import weakref
from dataclasses import dataclass, field

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator, SimulatorConfig
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import DiscreteTimeIntegrator

from tests.testbed.test_slow_part import Rig
from vtbdrake.state.layout import FlatState, LayoutError, StateLayout
from vtbdrake.testbed import DpsAlone, Interface, Scenario, Signal, SlowPart, VirtualTestbedBuilder
from vtbdrake.testbed.dps_state import DpsState

STEP = 0.01
PLANNER = "dps.planner"


def digest(contents: FlatState) -> float:
    """One number that every number of the contents changes."""
    rows = [contents.numbers, *contents.abstract.values()]
    return float(sum(np.cos(np.arange(1.0, row.size + 1.0)) @ np.nan_to_num(row.ravel(), neginf=-7.0) for row in rows))


def plan(dps: DpsState, position: np.ndarray) -> dict[str, np.ndarray]:
    seen = [dps.time, digest(dps.contents), *dps.commands["goal"], *position]
    return {"seen": np.array(seen), "velocity": np.cos(dps.contents.numbers[:1] + dps.time)}


@dataclass
class PlannedScenario(Scenario):
    """An axis whose velocity is what its planner makes of the state of the DPS, summed up."""

    simulator_config: SimulatorConfig = field(default_factory=lambda: SimulatorConfig(max_step_size=0.1, accuracy=1e-6))
    period: float = 0.05
    latency: float = 0.05
    offset: float = 0.0
    on_request: bool = False
    parts: int = 1

    def interface(self) -> Interface:
        request = [Signal("request", size=1)] if self.on_request else []
        return Interface(
            sense=[Signal("position", size=1, unit="m")],
            act=[Signal("velocity", size=1, unit="m/s", idle=0.0)],
            commands=[Signal("goal", size=2), *request],
        )

    def make_dps(self) -> Diagram:
        builder = DiagramBuilder()
        for n in range(self.parts):
            part = SlowPart(
                (lambda request, **inputs: plan(**inputs)) if self.on_request else plan,
                inputs={"position": 1},
                outputs={"seen": 5, "velocity": 1},
                period=self.period,
                latency=self.latency,
                offset=self.offset,
                on_request=self.on_request,
                samples_dps=True,
            )
            planner = builder.AddNamedSystem("planner" if n == 0 else f"planner_{n}", part)
            if n == 0:
                builder.ExportInput(planner.GetInputPort("position"), "position")
            else:
                builder.ConnectInput("position", planner.GetInputPort("position"))
        planner = builder.GetSubsystemByName("planner")
        if self.on_request:
            builder.ExportInput(planner.GetInputPort("request"), "request")
        law = builder.AddNamedSystem("law", DiscreteTimeIntegrator(1, STEP))
        goal = builder.AddNamedSystem("goal", DiscreteTimeIntegrator(2, STEP))
        builder.ExportInput(goal.get_input_port(), "goal")
        builder.Connect(planner.GetOutputPort("velocity"), law.get_input_port())
        builder.ExportOutput(law.get_output_port(), "velocity")
        return builder.Build()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        axis = builder.add("sys", "axis", DiscreteTimeIntegrator(1, STEP))
        builder.sim_sensor("position", axis.get_output_port())
        builder.sim_actuator("velocity", axis.get_input_port())


def started(scenario: Scenario):
    testbed = scenario.build()
    simulator = testbed.simulator()
    testbed.write(simulator.get_mutable_context(), {"u.goal": [0.4, -0.2]})
    return testbed, simulator


@pytest.mark.parametrize(("latency", "offset"), [(0.05, 0.0), (0.02, 0.0), (0.02, 0.013)])
def test_sample_is_the_state_before_the_updates_of_its_instant(latency, offset):
    testbed, simulator = started(PlannedScenario(latency=latency, offset=offset))
    context = simulator.get_context()
    expected = []
    for tick in range(6):
        at = 0.05 * tick + offset
        if at:  # Nothing happens in the millisecond before an offset.
            simulator.AdvanceTo(at - 0.001 if offset else at)
        position = testbed.read(context, "sim.sys.axis.discrete_state_0").item()
        expected.append([at, digest(testbed.dps_layout.take(context)), 0.4, -0.2, position])
    testbed, simulator = started(PlannedScenario(latency=latency, offset=offset))
    for tick, seen in enumerate(expected):
        simulator.AdvanceTo(offset + 0.05 * tick + latency + 0.001)
        assert testbed.read(simulator.get_context(), f"{PLANNER}.seen").tolist() == pytest.approx(
            seen, abs=1.1e-8, rel=0.0
        )
        assert testbed.read(simulator.get_context(), f"{PLANNER}.sampled_at") == offset + tick * 0.05


def test_part_of_a_dps_is_taken_from_the_whole():
    """The planner alone, and all but it, between them hold all numbers; a layout with more is refused."""
    testbed, simulator = started(PlannedScenario())
    simulator.AdvanceTo(0.17)
    whole = testbed.dps_layout.take(simulator.get_context())
    parts = [
        StateLayout(testbed.diagram, state=chosen, parameters=chosen)
        for chosen in (lambda path: path == PLANNER, lambda path: path.startswith("dps") and path != PLANNER)
    ]
    taken = [part.part_of(whole) for part in parts]
    for part, contents in zip(parts, taken, strict=True):
        expected = part.take(simulator.get_context())
        assert contents.names == expected.names and contents.abstract.keys() == expected.abstract.keys()
        assert np.array_equal(contents.numbers, expected.numbers)
    assert sum(contents.numbers.size for contents in taken) == whole.numbers.size > taken[0].numbers.size > 0
    with pytest.raises(LayoutError, match=f"the contents lack {PLANNER}"):
        testbed.dps_layout.part_of(taken[1])


def test_copy_in_mid_work_continues_alike():
    testbed, simulator = started(PlannedScenario())
    simulator.AdvanceTo(0.17)
    other = PlannedScenario().build()
    context = other.default_context()
    other.restore(context, testbed.snapshot(simulator.get_context()))
    simulator.AdvanceTo(0.4)
    other.simulator(context, restored=True).AdvanceTo(0.4)
    assert not other.snapshot(context).compare(testbed.snapshot(simulator.get_context()))


def test_dps_alone_samples_what_the_testbed_does():
    testbed, simulator = started(PlannedScenario())
    simulator.AdvanceTo(0.2)
    alone = DpsAlone(PlannedScenario())
    context = alone.continue_from(testbed, simulator.get_context())
    position = testbed.read(simulator.get_context(), "sim.sys.axis.discrete_state_0")
    alone.diagram.GetInputPort("real.sense.position").FixValue(context, position)
    simulator.AdvanceTo(0.2505)
    alone.simulator(context, restored=True).AdvanceTo(0.2505)
    seen = alone.read(context, f"{PLANNER}.seen")
    assert np.array_equal(seen, testbed.read(simulator.get_context(), f"{PLANNER}.seen")) and seen[0] == 0.2


def test_context_from_elsewhere_is_refused_until_it_is_attached():
    testbed, simulator = started(PlannedScenario())
    simulator.AdvanceTo(0.03)
    clone = simulator.get_context().Clone()
    with pytest.raises(ValueError, match="make the context with testbed.default_context"):
        Simulator(testbed.diagram, clone).AdvanceTo(0.06)
    with pytest.raises(ValueError, match="dps::planner samples the state of the whole DPS"):
        Simulator(testbed.diagram).AdvanceTo(0.06)
    again = simulator.get_context().Clone()
    testbed.simulator(again, restored=True).AdvanceTo(0.06)
    simulator.AdvanceTo(0.06)
    assert not testbed.snapshot(again).compare(testbed.snapshot(simulator.get_context()))


def test_testbed_and_context_are_freed():
    testbed, simulator = started(PlannedScenario())
    simulator.AdvanceTo(0.1)
    dead = [weakref.ref(testbed), weakref.ref(testbed.dps), weakref.ref(simulator.get_mutable_context())]
    del testbed, simulator
    gc.collect()
    assert [reference() for reference in dead] == [None] * 3


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"parts": 2}, "at most one slow part that samples its state, not 2: dps.planner, dps.planner_1"),
        ({"latency": 0.06}, "choose a period of at least 0.06 s"),
        ({"latency": 0.05, "offset": 0.01}, "needs a period longer than its latency of 0.05 s"),
    ],
)
def test_more_than_one_sample_at_a_time_is_refused(settings, told):
    with pytest.raises(ValueError, match=told):
        PlannedScenario(**settings).build()


# -- on request


def test_work_is_done_once_for_each_new_request():
    testbed, simulator = started(PlannedScenario(on_request=True, latency=0.12))
    context = simulator.get_mutable_context()
    changes = []
    # A request during work is taken afterwards; 0 is none; the one that was taken last is not taken again.
    requests = {5: 1.0, 15: 2.0, 40: 0.0, 45: 2.0, 60: 1.0}
    for n in range(100):
        if n in requests:
            testbed.write(context, {"u.request": requests[n]})
        simulator.AdvanceTo((n + 1) * STEP)
        read = [testbed.read(context, f"{PLANNER}.{name}") for name in ("taken", "sampled_at", "valid")]
        if not changes or read != changes[-1][1:]:
            changes.append([n, *read])
    assert changes == [
        [0, 0.0, -np.inf, 0.0],
        [5, 1.0, -np.inf, 0.0],
        [16, 1.0, pytest.approx(0.05), 1.0],
        [20, 2.0, pytest.approx(0.05), 1.0],
        [31, 2.0, pytest.approx(0.2), 1.0],
        [60, 1.0, pytest.approx(0.2), 1.0],
        [71, 1.0, pytest.approx(0.6), 1.0],
    ]


# -- no result


@pytest.mark.parametrize("memory", [None, 0.0])
def test_function_without_a_result_makes_it_missing(memory):
    def odd(t, memory=0.0):
        found = {"y": t} if round(t.item() / 0.05) % 2 else None
        return (found, memory + 1.0) if remembers else found

    remembers = memory is not None
    rig = Rig(odd, latency=0.03, memory=memory)
    rig.advance(0.181)
    assert (rig.read("y"), rig.read("valid"), rig.read("missed")) == (pytest.approx(0.15), 1.0, 2.0)
    rig.advance(0.231)
    assert (rig.read("y"), rig.read("valid"), rig.read("missed")) == (pytest.approx(0.15), 0.0, 3.0)
    if remembers:
        assert rig.part.memory(rig.context)["memory"] == 5.0
