"""The supervisor alone: transitions that captures rarely make."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from vtbdrake.state.systems import collect
from vtbdrake_diagrams.satellite.bodies import JOINT_NAMES, Servicer, Target
from vtbdrake_diagrams.satellite.supervisor import PLAN, PLAN_TIME_OF_NONE, Arrival, Guidance, Mode, Reason, Supervisor

T = 0.02
BAR = 2.0 * Target().bar_radius


class Bench:
    """A supervisor with a gripper that is where it should be, and fingers that stop at a gap."""

    def __init__(self, mode: float, *, plan_duration: float | None = None) -> None:
        builder = DiagramBuilder()
        supervisor = Supervisor(period=T, acceleration=10.0, plan_duration=plan_duration)
        self.system = builder.AddNamedSystem("supervisor", supervisor)
        diagram = builder.Build()
        self.simulator = Simulator(diagram)
        self.root = self.simulator.get_mutable_context()
        self.context = self.system.GetMyMutableContextFromRoot(self.root)
        self.variables = collect(diagram)
        self.system.GetInputPort("capture").FixValue(self.context, [1.0])
        self.see()
        self.close(2.0 * Servicer().opening)
        self.set("mode", mode)

    def see(self, *, age: float = 0.1, valid: float = 1.0, turn: float = 0.0, speed: float = 0.0) -> None:
        """Let the gripper be at the fixture, straight ahead of the arm."""
        R = RotationMatrix(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]))
        R_BH = (RotationMatrix.MakeZRotation(turn) @ R).matrix().ravel()
        p = [1.9, 0.0, -0.2]
        relative = [age, valid, *R_BH, *p, 0.0, 0.0, 0.0, speed, 0.0, 0.0, *R_BH, *p]
        self.system.GetInputPort("relative").FixValue(self.context, relative)

    def close(self, gap: float, *, turn: float = 0.0) -> None:
        """Let the fingers stand so far apart, and the first joint at an angle."""
        joints = np.zeros(len(JOINT_NAMES))
        joints[0], joints[-2:] = turn, gap / 2.0
        self.system.GetInputPort("joint_position").FixValue(self.context, joints)

    def answer(self, *, begin: float = PLAN_TIME_OF_NONE, fixture: float = 1.9, missed: float = 0.0) -> None:
        """Let the planner have answered: a plan that begins then, with the fixture at ``fixture`` m at its end."""
        target = np.zeros(13)
        target[0], target[4:7] = 1.0, [fixture, 0.0, 0.0] - Target().X_TH.translation()
        plan = np.append(begin, np.zeros(PLAN - 1))
        values = {"target": target, "plan": plan, "fixture": [1.9, 0.0, 0.0], "missed": [missed]}
        for name, value in values.items():
            self.system.GetInputPort(name).FixValue(self.context, value)

    def set(self, name: str, value: float) -> None:
        self.variables[f"supervisor.{name}"].set(self.root, value)

    def get(self, name: str) -> float:
        return float(self.variables[f"supervisor.{name}"].get(self.root))

    def run(self, seconds: float) -> float:
        """Go on for some time, and return the mode."""
        self.simulator.AdvanceTo(self.root.get_time() + seconds)
        return self.get("mode")


def test_held_bar_leads_to_hold() -> None:
    bench = Bench(Mode.GRIP)
    bench.close(0.95 * BAR)
    assert bench.run(1.0) == Mode.RETREAT
    assert bench.run(7.0) == Mode.HOLD


@pytest.mark.parametrize(("rate", "expected"), [(4e-3, Mode.RETREAT), (1e-3, Mode.HOLD)])
def test_retreat_lasts_until_the_joints_rest(rate: float, expected: float) -> None:
    bench = Bench(Mode.RETREAT)
    for k in range(500):
        bench.close(0.95 * BAR, turn=rate * k * T)
        bench.run(T)
    assert bench.get("mode") == expected
    bench.run(3.0)
    assert bench.get("mode") == Mode.HOLD


def test_missed_bar_is_tried_again_and_then_aborted() -> None:
    bench = Bench(Mode.GRIP)
    bench.set("attempts", 2.0)
    bench.close(0.0)
    assert bench.run(0.8) == Mode.APPROACH
    assert bench.get("opening") == Servicer().opening
    bench.set("mode", Mode.GRIP)
    assert bench.run(0.8) == Mode.ABORT
    assert bench.get("reason") == Reason.MISSED_TOO_OFTEN


@pytest.mark.parametrize("mode", [Mode.RETREAT, Mode.HOLD])
def test_lost_bar_is_noticed(mode: float) -> None:
    bench = Bench(mode)
    bench.close(0.95 * BAR)
    assert bench.run(0.5) == mode
    bench.close(0.0)
    assert bench.run(0.5) == Mode.ABORT
    assert bench.get("reason") == Reason.SLIPPED


def test_all_holds_while_nothing_new_is_seen() -> None:
    bench = Bench(Mode.TRACK)
    bench.set("distance", 0.0)
    bench.see(age=1.5)
    assert bench.run(1.0) == Mode.TRACK
    guidance = Guidance.of(bench.system.get_output_port().Eval(bench.context))
    assert not guidance.follows
    bench.see(age=0.1)
    assert bench.run(0.4) == Mode.GRIP


@pytest.mark.parametrize("seen", [{"turn": 1.2}, {"valid": 0.0}, {"age": 2.0}])
def test_no_start_without_a_target_in_reach(seen: dict[str, float]) -> None:
    bench = Bench(Mode.WAIT)
    bench.see(**seen)
    assert bench.run(1.0) == Mode.WAIT
    bench.see()
    assert bench.run(0.1) == Mode.APPROACH


def planning(bench: Bench) -> tuple[float, float]:
    """Return how the gripper comes before the bar, and whether it follows the fixture."""
    return bench.get("arrival"), bench.get("follows")


def asked() -> Bench:
    """Return a supervisor that has asked for a plan of 2 s."""
    bench = Bench(Mode.WAIT, plan_duration=2.0)
    bench.answer()
    assert bench.run(1.0) == Mode.APPROACH
    assert (planning(bench), bench.get("request")) == ((Arrival.PLANNING, 0.0), 0.0)
    bench.run(1.2)  # It has watched the target.
    assert (planning(bench), bench.get("request")) == ((Arrival.PLANNING, 0.0), 1.0)
    return bench


def test_plan_leads_the_approach_until_it_ends() -> None:
    bench = asked()
    bench.answer(begin=bench.root.get_time() + 0.1)
    bench.run(2.0)
    assert planning(bench) == (Arrival.PLANNED, 0.0)
    bench.run(0.3)
    assert planning(bench) == (Arrival.ARRIVED, 1.0)
    bench.set("distance", 0.0)
    assert bench.run(0.6) == Mode.TRACK


def test_resolved_rate_leads_where_there_is_no_plan() -> None:
    bench = asked()
    bench.answer(missed=1.0)
    bench.run(0.1)
    assert planning(bench) == (Arrival.REFUSED, 1.0)


@pytest.mark.parametrize("trouble", ["drift", "age"])
def test_plan_to_another_place_is_dropped(trouble: str) -> None:
    bench = asked()
    begin = bench.root.get_time() + 0.1
    bench.answer(begin=begin)
    bench.run(0.5)
    assert planning(bench) == (Arrival.PLANNED, 0.0)
    if trouble == "drift":
        bench.answer(begin=begin, fixture=2.1)
    else:
        bench.see(age=1.5)
    bench.run(0.5)
    assert planning(bench) == (Arrival.DROPPED, 0.0)  # It stops.
    bench.see()
    bench.run(0.6)
    assert planning(bench) == (Arrival.DROPPED, 1.0)


def test_speed_against_a_base_that_turns_as_planned_is_no_trouble() -> None:
    bench = asked()
    bench.answer(begin=bench.root.get_time() + 0.1)
    bench.run(0.5)
    bench.see(speed=0.3)
    assert bench.run(0.5) == Mode.APPROACH
    bench.run(1.3)
    assert bench.get("reason") == Reason.TOO_FAST
