"""The quadruped is pushed: how often does it fall? With a reasoner on board that replans its steps, and without.

Without one, it trots on the spot, or puts its feet where Raibert's rule says (`Raibert`).
``python -m vtbdrake_diagrams.quadruped.studies.pushes [--pushes N] [--sizes J ...]`` prints the shares of falls.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import sqrt

import click
import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.testbed import VirtualTestbed
from vtbdrake_diagrams.quadruped.decision import LIMITS
from vtbdrake_diagrams.quadruped.dps import PERCEIVED
from vtbdrake_diagrams.quadruped.gait import Trot
from vtbdrake_diagrams.quadruped.scenario import QuadrupedScenario

SIZES = (24.0, 32.0, 16.0)
"""Impulses in N s."""
SEED = 2026
"""The seed of the pushes; the settings of the reasoner were chosen with others."""
RAIBERT_GAIN = 0.25
"""Gain of `Raibert` in s, the least of those with the fewest falls (5 of 12 pushes of 24 N s with the
seed 7): 0.1, 0.15, 0.2, 0.25, 0.3."""
# How long the robot is watched after the begin of a push, in s.
_AFTER = 1.5
# It falls when the cosine of the trunk's tilt, or its height in m, is smaller.
_LEAST_UPRIGHT = 0.5
_LEAST_HEIGHT = 0.15


@dataclass(frozen=True)
class PushCase:
    """A horizontal push on the trunk.

    Attributes:
        impulse: Impulse in N s; the force acts for 0.1 s.
        direction: Direction in rad, from the x axis; the robot looks along x.
        begin: When it begins, in s.
    """

    impulse: float
    direction: float
    begin: float


def draw_pushes(impulse: float, count: int, *, seed: int = SEED) -> list[PushCase]:
    """Return pushes of one size from random directions, in random phases of the trot.

    Args:
        impulse: Impulse in N s.
        count: Number of pushes.
        seed: Seed of directions and times, which are the same for all sizes.
    """
    random = np.random.default_rng(seed)
    return [PushCase(impulse, *each) for each in random.uniform([0.0, 0.2], [2.0 * np.pi, 0.56], (count, 2)).tolist()]


def fall_time(
    testbed: VirtualTestbed, case: PushCase, *, replan: Callable[[Context], None] = lambda context: None
) -> float | None:
    """Simulate a push; return when the robot falls, in s, or None.

    Args:
        testbed: The testbed of a `QuadrupedScenario`.
        case: The push.
        replan: Called at each sample time of a planner, for a planner outside the DPS.
    """
    context = testbed.default_context()
    along = np.array([np.cos(case.direction), np.sin(case.direction), 0.0])
    testbed.write(context, {"sim.env.push.impulse": case.impulse * along, "sim.env.push.begin": case.begin})
    simulator, state = testbed.simulator(context), testbed.reader("plant.state")
    scenario = testbed.scenario
    assert isinstance(scenario, QuadrupedScenario)
    for k in range(round((case.begin + _AFTER) / scenario.thinking_period)):
        simulator.AdvanceTo(k * scenario.thinking_period)
        if has_fallen(state(context)):
            return k * scenario.thinking_period
        replan(context)
    return None


def has_fallen(state: np.ndarray) -> bool:
    """Return whether the trunk is tilted by more than 60 degrees, or lies on the ground.

    Args:
        state: State of the plant, [q; v].
    """
    w, x, y, z = state[:4]
    upright = 1.0 - 2.0 * (x * x + y * y) / (w * w + x * x + y * y + z * z)
    return bool(upright < _LEAST_UPRIGHT or state[6] < _LEAST_HEIGHT)


class Raibert:
    """Replans by rule, for `fall_time`: it reasons about nothing.

    A pair of legs that swings is put down at ``gain (v - v_d)`` beside the place that its trot has for it, with the
    velocity v of the trunk and the commanded one v_d, forwards and to the left; a pair that stands stays where it is
    (Raibert, Legged Robots That Balance, MIT Press 1986, chapter 2).

    Args:
        testbed: The testbed of a `QuadrupedScenario` without a reasoner on board.
        gain: The gain in s.
    """

    def __init__(self, testbed: VirtualTestbed, gain: float = RAIBERT_GAIN) -> None:
        self._testbed, self._gain = testbed, gain
        scenario = testbed.scenario
        assert isinstance(scenario, QuadrupedScenario)
        self._knots = scenario.knots
        self._shifts = np.zeros((2, 2))  # by pair, in m

    def __call__(self, context: Context) -> None:
        """Write the plan for the next sample times of a planner."""
        time, trot = context.get_time(), Trot().period
        if time == 0.0:
            self._shifts[:] = 0.0
        state, velocity = (np.array(self._testbed.read(context, name)) for name in (PERCEIVED, "u.velocity"))
        w, x, y, z = state[:4]
        ahead = np.array([w * w + x * x - y * y - z * z, 2.0 * (x * y + w * z)])
        ahead /= np.linalg.norm(ahead)
        v = np.array([ahead @ state[22:24], ahead[0] * state[23] - ahead[1] * state[22]])
        swinging = 0 if time % trot < 0.5 * trot else 1
        self._shifts[swinging] = np.clip(self._gain * (v - velocity), -LIMITS[:2], LIMITS[:2])
        knot = np.append(self._shifts.ravel(), [0.0, 0.0])
        self._testbed.write(context, {"u.plan": np.append(time, np.tile(knot, self._knots))})


@dataclass(frozen=True)
class Shares:
    """The shares of pushes after which the robot fell.

    Attributes:
        impulse: Impulse of the pushes in N s.
        pushes: Number of pushes.
        falls: Number of falls.
        seconds: Processor time per simulated second, in s.
    """

    impulse: float
    pushes: int
    falls: int
    seconds: float

    def __str__(self) -> str:
        """Show the share of falls with its standard error, in percent."""
        p = self.falls / self.pushes
        return f"{100.0 * p:.0f} % +- {100.0 * sqrt(p * (1.0 - p) / self.pushes):.0f} ({self.falls} of {self.pushes})"


def shares(
    testbed: VirtualTestbed,
    impulse: float,
    count: int,
    *,
    seed: int = SEED,
    replan: Callable[[Context], None] = lambda context: None,
) -> Shares:
    """Return how often the robot falls when it is pushed; see `draw_pushes` and `fall_time`.

    Args:
        testbed: The testbed of a `QuadrupedScenario`.
        impulse: Impulse in N s.
        count: Number of pushes.
        seed: Seed of the pushes.
        replan: A planner outside the DPS.
    """
    begin, simulated, falls = time.process_time(), 0.0, 0
    for case in draw_pushes(impulse, count, seed=seed):
        fall = fall_time(testbed, case, replan=replan)
        falls += fall is not None
        simulated += case.begin + _AFTER if fall is None else fall
    return Shares(impulse, count, falls, (time.process_time() - begin) / simulated)


def compare(sizes: Sequence[float], count: int) -> Iterator[tuple[Shares, Shares, Shares]]:
    """Yield the shares of falls by the trot alone, by Raibert's rule, and with a reasoner on board.

    Args:
        sizes: Impulses in N s.
        count: Number of pushes of each size.
    """
    plain, reasoning = (QuadrupedScenario(onboard=onboard).build() for onboard in (False, True))
    raibert = Raibert(plain)
    for size in sizes:
        yield shares(plain, size, count), shares(plain, size, count, replan=raibert), shares(reasoning, size, count)


@click.command()
@click.option("--pushes", default=12, show_default=True, help="Pushes of each size.")
@click.option("--sizes", default=SIZES, multiple=True, show_default=True, help="Impulses in N s.")
def main(pushes: int, sizes: tuple[float, ...]) -> None:
    """Print the shares of falls."""
    for plain, raibert, reasoning in compare(sizes, pushes):
        click.echo(
            f"{plain.impulse:g} N s: falls by the trot alone {plain}, by Raibert's rule {raibert}, with the reasoner "
            f"on board {reasoning}, which takes {reasoning.seconds - plain.seconds:.2f} s of processor time per s"
        )


if __name__ == "__main__":
    main()
