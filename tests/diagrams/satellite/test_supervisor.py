"""The supervisor alone: transitions that captures rarely make."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from vtbdrake.state.systems import collect
from vtbdrake_diagrams.satellite.bodies import JOINT_NAMES, Servicer, Target
from vtbdrake_diagrams.satellite.supervisor import Guidance, Mode, Reason, Supervisor

T = 0.02
BAR = 2.0 * Target().bar_radius


class Bench:
    """A supervisor with a gripper that is where it should be, and fingers that stop at a gap."""

    def __init__(self, mode: float) -> None:
        builder = DiagramBuilder()
        self.system = builder.AddNamedSystem("supervisor", Supervisor(period=T, acceleration=10.0))
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
