"""The climber whose DPS finds its way out of a crater: its pilot, what its head remembers, and both on a machine."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from tests.diagrams.lock_step_loop import deployed, run_all
from vtbdrake.testbed import DpsAlone, ScenarioError
from vtbdrake_diagrams.space_climber.believed_terrain import BelievedTerrain
from vtbdrake_diagrams.space_climber.crater_scenario import X_BL
from vtbdrake_diagrams.space_climber.standing_scanner import StandingScanner
from vtbdrake_diagrams.space_climber.studies.explorer import Explorer
from vtbdrake_diagrams.space_climber.studies.exploring import (
    LATENCY,
    PERIOD,
    TERRAIN_CODEC,
    ExploringScenario,
    Phase,
    Pilot,
)
from vtbdrake_diagrams.space_climber.studies.perceived import (
    BLOCKED_AHEAD,
    BLOCKED_WITHIN,
    GOING_BACK,
    LEG,
    LOOKING,
    Site,
)
from vtbdrake_diagrams.space_climber.studies.rover import SEGMENT, true_world
from vtbdrake_diagrams.space_climber.survey import survey
from vtbdrake_diagrams.space_climber.terrain import Crater

SEED = 1000
INPUTS: Mapping[str, list[float]] = {
    "pose": [0.0] * 6,
    "navigation": [0.0] * 12,
    "explore": [1.0],
    "decision": [0.0] * 3,
    "sampled_at": [-np.inf],
    "missed": [0.0],
}


class Rig:
    """The pilot alone, and what it gets at its ports."""

    def __init__(self) -> None:
        self.pilot = Pilot()
        self.simulator = Simulator(self.pilot)
        self.set(**INPUTS)

    def set(self, **values: list[float]) -> None:
        for name, value in values.items():
            self.pilot.GetInputPort(name).FixValue(self.simulator.get_mutable_context(), value)

    def until(self, time: float) -> None:
        """Go on to a time in s, the step at that instant included."""
        self.simulator.AdvanceTo(time + 0.5 * PERIOD)

    def output(self, name: str) -> np.ndarray:
        return self.pilot.GetOutputPort(name).Eval(self.simulator.get_context())

    @property
    def phase(self) -> Phase:
        return Phase(int(self.pilot.phase.view(self.simulator.get_context()).phase))

    def go(self, heading: float) -> float:
        """Let it ask, and answer; return when it goes."""
        self.until(LOOKING)
        assert self.phase == Phase.ASK and self.output("request") == 1.0 and self.output("walk") == 0.0
        begin = LOOKING + LATENCY
        self.until(begin - PERIOD)
        assert self.phase == Phase.ASK  # There is no answer yet.
        self.set(decision=[heading, 1.0, 1.0], sampled_at=[LOOKING + PERIOD])
        self.until(begin)
        assert self.phase == Phase.WALK and (self.output("heading"), self.output("walk")) == (heading, 1.0)
        return begin


def test_pilot_walks_a_leg_and_tells_of_it() -> None:
    rig = Rig()
    begin = rig.go(0.3)
    for k in range(1, round(LEG / SEGMENT) + 1):
        rig.set(pose=[0.0, 0.0, 0.0, 0.9 * k, 0.0, 0.2], navigation=[0.8 * k, 0.1 * k, *[0.0] * 10])
        rig.until(begin + k * SEGMENT)
    assert rig.phase == Phase.LOOK and rig.output("walk") == 0.0
    places, blocked, _, _, stepped, *path = rig.output("leg")
    assert (places, blocked, stepped) == (5.0, 0.0, pytest.approx(3.6))
    np.testing.assert_allclose(np.reshape(path, (-1, 2)), [[0.8 * k, 0.1 * k] for k in range(5)])
    rig.until(begin + LEG + LOOKING)
    assert rig.output("request") == 2.0


def test_blocked_pilot_goes_back_as_it_came() -> None:
    rig = Rig()
    yaw = 0.5
    rig.set(pose=[0.0, 0.0, yaw, 0.0, 0.0, 0.2], navigation=[2.0, 1.0, *[0.0] * 10])
    begin = rig.go(0.3)
    rig.until(begin + BLOCKED_WITHIN)
    assert rig.phase == Phase.BACK and (rig.output("heading"), rig.output("walk")) == (yaw, -1.0)
    _, blocked, x, y, *_ = rig.output("leg")
    assert blocked == 1.0
    np.testing.assert_allclose([x, y], [2.0 + BLOCKED_AHEAD * np.cos(yaw), 1.0 + BLOCKED_AHEAD * np.sin(yaw)])
    rig.until(begin + BLOCKED_WITHIN + GOING_BACK)
    assert rig.phase == Phase.LOOK and rig.output("walk") == 0.0


@pytest.mark.parametrize("answer", ["late", "stand"])
def test_pilot_stands_and_asks_again(answer: str) -> None:
    rig = Rig()
    rig.until(LOOKING + LATENCY)
    if answer == "late":
        rig.set(missed=[1.0])
    else:
        rig.set(decision=[0.0, 1.0, 0.0], sampled_at=[LOOKING + PERIOD])
    rig.until(2.0 * (LOOKING + LATENCY))
    assert rig.output("walk") == 0.0 and rig.output("request") == 2.0


def test_pilot_stands_when_it_is_told_to() -> None:
    rig = Rig()
    begin = rig.go(0.3)
    rig.set(explore=[0.0])
    rig.until(begin + PERIOD)
    assert rig.output("walk") == 0.0
    rig.until(begin + 3.0 * LOOKING)
    assert rig.output("request") == 1.0


def test_what_is_believed_is_remembered_exactly() -> None:
    crater = Crater(SEED, rock_cover=0.03)
    prior = survey(crater, seed=0)
    X_WB = RigidTransform([0.0, 0.0, 0.2 + float(crater.height(0.0, 0.0))])
    terrain = BelievedTerrain(prior.ground, prior.rocks)
    terrain = terrain.after_scan(StandingScanner(crater).scan(X_WB, 4.0), X_WB @ X_BL).after_block([1.0, 2.0])
    again = TERRAIN_CODEC.decode(TERRAIN_CODEC.encode(terrain))
    assert np.array_equal(again.ground.heights, terrain.ground.heights)
    assert np.array_equal(again.rocks.positions(), terrain.rocks.positions()) and len(again.rocks) > len(prior.rocks)
    for name in ("friction", "friction_variance", "obstacles"):
        assert np.array_equal(getattr(again, name), getattr(terrain, name))


def test_robot_without_a_scanner_is_refused() -> None:
    with pytest.raises(ScenarioError, match=r"scans must be True, not False: the robot decides by what it sees"):
        ExploringScenario(scans=False).build()


@pytest.mark.slow
def test_dps_decides_in_drake_and_on_a_machine_as_the_judged_robot_does() -> None:
    """The robot of `perceived` in Drake, the simulation of the whole DPS, and a process of its own: one decision."""
    site = Site(SEED, in_drake=True)
    rover = site.rover()
    rover.advance(LOOKING + PERIOD, walk=0.0)
    stop = Explorer(site.world, site.terrain).decide(rover)
    scenario = ExploringScenario.in_world(true_world(SEED))
    testbed, dps = scenario.build(), DpsAlone(scenario)
    simulated, own = testbed.default_context(), dps.default_context()
    end = LOOKING + PERIOD + LATENCY + 4.0
    simulator = testbed.simulator(simulated)
    simulator.AdvanceTo(LOOKING + 2.0 * PERIOD)
    in_between = testbed.snapshot(simulated)
    simulator.AdvanceTo(end)
    with deployed(scenario, dps, own, paced_by="joint_encoders") as (runtime, _):
        run_all(runtime, round(end / scenario.period))
        decided = [target.read(context, "dps.head.decision") for target, context in ((testbed, simulated), (dps, own))]
        gains = [target.read(context, "dps.head.gain") for target, context in ((testbed, simulated), (dps, own))]
    assert np.array_equal(decided[0], [stop.heading, stop.walk, 1.0])
    np.testing.assert_allclose(decided[1], decided[0], atol=1e-6)
    assert gains[1] == pytest.approx(gains[0], abs=0.05) and gains[0] > 3.0
    assert testbed.read(simulated, "dps.impl.navigator.position")[0] > 0.3  # It walks.
    # What is saved while it thinks goes on alike elsewhere.
    other = scenario.build()
    restored = other.default_context()
    other.restore(restored, in_between)
    other.simulator(restored, restored=True).AdvanceTo(end)
    assert not other.snapshot(restored).compare(testbed.snapshot(simulated))
