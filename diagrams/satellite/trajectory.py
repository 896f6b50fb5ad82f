"""Application R2: which trajectory of the arm disturbs the base least, and is it so in the full testbed?

``python -m vtbdrake_diagrams.satellite.trajectory [FILE]`` moves the arm from its stowed pose to that of a capture, on
the straight path and on the plan that the DPS decides on board, and plots the deviation of the base.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vtbdrake.components.compiled_plant import rotation_angle
from vtbdrake.optimization import Problem
from vtbdrake_diagrams.answers import Answer
from vtbdrake_diagrams.satellite.arm_motion import (
    BASE,
    DEVIATION,
    PLAN,
    SAMPLE_PERIOD,
    ArmMotionScenario,
    free_knots,
    limits,
)
from vtbdrake_diagrams.satellite.arm_move import REACHING
from vtbdrake_diagrams.satellite.arm_planning import plan_by_casadi
from vtbdrake_diagrams.satellite.bodies import ARM_JOINTS, Servicer

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

# How far starts are from the stowed pose, and goals from the middle of the workspace, at most; in rad.
_START_SPREAD, _GOAL_SPREAD = 0.2, 0.6
# The least ratio of the deviations that answers the question, and how many pairs are asked.
_RATIO, _PAIRS, _PAIRS_FULL = 10.0, 10, 30
# What the servos add to the rates of the plan, and to its largest deviation; shares.
_OVERSHOOT = 0.05
# How far the arm may be from its goal in the end, in rad.
_MISS = 1e-3


@dataclass(frozen=True)
class Course:
    """A motion of the arm in the full testbed.

    Attributes:
        times: Times in s, shape (n,).
        deviations: Deviations of the base's attitude in rad, shape (n,).
        rates: The largest rate of each joint, as a share of its limit, shape (7,).
        torques: The largest torque of each drive, as a share of its limit, shape (7,).
        miss: Distance of the joints from the goal at the end, in rad.
    """

    times: Array
    deviations: Array
    rates: Array
    torques: Array
    miss: float

    @property
    def end(self) -> float:
        """Return q, the deviation at the end, in rad."""
        return float(self.deviations[-1])

    @property
    def largest(self) -> float:
        """Return the largest deviation, in rad."""
        return float(self.deviations.max())


def simulate(scenario: ArmMotionScenario, knots: Array | None = None) -> Course:
    """Simulate a motion of the arm in the full testbed.

    Args:
        scenario: The motion.
        knots: Knots of the plan in rad, shape (n, 7); None takes the scenario's: the straight path, or the decision on
            board.
    """
    testbed = scenario.build()
    simulator = testbed.simulator()
    context = simulator.get_mutable_context()
    if knots is not None:
        testbed.write(context, {PLAN: scenario.plan(knots)})
    pose = testbed.reader(BASE)
    state, effort = testbed.reader("plant.servicer_state"), testbed.reader("plant.servicer_net_actuation")
    times = np.linspace(0.0, scenario.horizon, round(scenario.horizon / SAMPLE_PERIOD) + 1)
    poses, states, efforts = [], [], []
    for instant in times.tolist():
        simulator.AdvanceTo(instant)
        for samples, read in ((poses, pose), (states, state), (efforts, effort)):
            samples.append(np.array(read(context)))
    servicer = Servicer()
    x = np.array(states)
    q, v = x[:, 7:14], x[:, 22:29]
    return Course(
        times=times,
        deviations=rotation_angle(np.array(poses)[:, :4]),
        rates=np.max(np.abs(v), axis=0) / servicer.speeds,
        torques=np.max(np.abs(np.array(efforts)[:, :ARM_JOINTS]), axis=0) / np.array(servicer.torques),
        miss=float(np.max(np.abs(q[-1] - scenario.goal))),
    )


def search_problem(scenario: ArmMotionScenario) -> Problem:
    """Return R2 as a problem of the full testbed, for black-box search: `Problem.study`."""
    return Problem(
        scenario=scenario,
        parameters=free_knots(scenario, PLAN),
        quality=DEVIATION,
        horizon=scenario.horizon,
        sample_period=SAMPLE_PERIOD,
        constraints=limits(scenario, PLAN),
    )


def random_scenarios(count: int, *, seed: int = 0) -> list[ArmMotionScenario]:
    """Return motions from poses near the stowed one to poses that reach forward, whose straight paths keep the limits.

    Args:
        count: Number of motions.
        seed: Seed of the random numbers.
    """
    random, found = np.random.default_rng(seed), []
    servicer = Servicer()
    while len(found) < count:
        start = servicer.stowed + random.uniform(-_START_SPREAD, _START_SPREAD, ARM_JOINTS)
        goal = REACHING + random.uniform(-_GOAL_SPREAD, _GOAL_SPREAD, ARM_JOINTS)
        if (goal < servicer.lower).any() or (goal > servicer.upper).any():
            continue
        scenario = ArmMotionScenario(start=tuple(start), goal=tuple(goal), thinking_time=0.5)
        move = scenario.move()
        if not move.excess(move.straight):
            found.append(scenario)
    return found


@dataclass(frozen=True)
class Comparison:
    """The straight path of a motion beside the best plan, both in the full testbed."""

    straight: Course
    best: Course

    @property
    def ratio(self) -> float:
        """Return the ratio of the deviations at the end, of the straight path over the best plan."""
        return self.straight.end / self.best.end

    @property
    def within_limits(self) -> bool:
        """Return whether rates, torques, the goal and the deviation on the way are kept in the full testbed."""
        rates, torques = self.best.rates.max(), self.best.torques.max()
        arrives = self.best.miss < 1e-3
        return bool(max(rates, torques) <= 1.0 + _OVERSHOOT) and arrives and self.turns_within

    @property
    def turns_within(self) -> bool:
        """Return whether the deviation on the way is that of the straight path at most."""
        return self.best.largest <= (1.0 + _OVERSHOOT) * self.straight.largest


def compare(scenario: ArmMotionScenario) -> Comparison:
    """Return the straight path beside the best plan by the momentum model, or that decided on board."""
    straight = simulate(replace(scenario, onboard=False))
    knots = None if scenario.onboard else plan_by_casadi(scenario.move()).knots
    return Comparison(straight, simulate(scenario, knots))


def answer(full: bool) -> Answer:
    """Answer R2: which trajectory of the arm disturbs the base least?"""
    onboard = compare(ArmMotionScenario(onboard=True))
    pairs = [compare(scenario) for scenario in random_scenarios(_PAIRS_FULL if full else _PAIRS)]
    everything = [onboard, *pairs]
    ratios = np.array([pair.ratio for pair in everything])
    degrees = np.degrees([(pair.straight.end, pair.best.end) for pair in everything])
    return Answer(
        id="R2",
        question="Which trajectory of a service satellite's arm disturbs its base least?",
        answer=float(np.median(ratios)),
        unit="times less rotation at the end than on the straight joint-space path",
        interval=(float(ratios.min()), float(ratios.max())),
        paper="none given",
        holds=bool(ratios.min() >= _RATIO) and all(pair.within_limits for pair in everything),
        note=(
            f"In the full testbed: the DPS's decision on board turns the base by {degrees[0, 1]:.3f} deg instead of "
            f"{degrees[0, 0]:.2f}; {len(pairs)} random pairs by at most {degrees[1:, 1].max():.3f} deg, instead of "
            f"{degrees[1:, 0].min():.2f} to {degrees[1:, 0].max():.2f}."
        ),
    )


def plot(courses: dict[str, Course]) -> Figure:
    """Return the deviation of the base over time.

    Args:
        courses: The courses by name.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 3.2), layout="constrained")
    axes = figure.add_subplot()
    for name, course in courses.items():
        label = f"{name}: {np.degrees(course.end):.2f} deg in the end"
        axes.plot(course.times, np.degrees(course.deviations), label=label)
    axes.set(xlabel="time (s)", ylabel="rotation of the base (deg)")
    axes.legend()
    axes.grid(alpha=0.3)
    return figure


def main(path: str) -> None:
    """Simulate both motions, and write the plot."""
    comparison = compare(ArmMotionScenario(onboard=True))
    plot({"straight path": comparison.straight, "decided on board": comparison.best}).savefig(path, dpi=120)


if __name__ == "__main__":
    main(*sys.argv[1:] or ["arm_trajectory.png"])
