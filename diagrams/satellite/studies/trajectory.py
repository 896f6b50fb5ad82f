"""Application R2: which trajectory of the arm disturbs the base least, and is it so in the full testbed?

``python -m vtbdrake_diagrams.satellite.studies.trajectory [FILE]`` moves the arm from its stowed pose to the pose of a
capture, on the straight path and on the plan that the DPS decides on board, and plots the deviation of the base. With
``--pairs N`` it prints what becomes of N random pairs of start and goal instead: those that are missing in
``trajectory.json`` beside this module are planned and simulated first, and each is kept there. The row of the answers
reads them, and makes a tenth of them again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from vtbdrake.common.arrays import Array
from vtbdrake.components.compiled_plant import rotation_angle
from vtbdrake.optimization import Problem
from vtbdrake.testbed import ScenarioError
from vtbdrake_diagrams.answers import Answer
from vtbdrake_diagrams.kept_results import read_results, repeat, write_results
from vtbdrake_diagrams.processes import in_processes
from vtbdrake_diagrams.satellite.arm_move import REACHING
from vtbdrake_diagrams.satellite.arm_planning import plan_calmly
from vtbdrake_diagrams.satellite.bodies import ARM_JOINTS, Servicer
from vtbdrake_diagrams.satellite.clearance import DrakeClearance
from vtbdrake_diagrams.satellite.studies.arm_motion import (
    BASE,
    DEVIATION,
    PERIOD,
    PLAN,
    SAMPLE_PERIOD,
    ArmMotionScenario,
    free_knots,
    limits,
)
from vtbdrake_diagrams.satellite.studies.planned_capture import PlannedCaptures, captures_again, kept_captures, median

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RESULTS = Path(__file__).with_suffix(".json")
"""The pairs that are kept."""
COMMAND = "python -m vtbdrake_diagrams.satellite.studies.trajectory --pairs 100"
"""The command that makes them."""

# Largest distance of a start from the stowed pose, in rad.
_START_SPREAD = 0.2
# Largest distance of a goal from the middle of the workspace, in rad.
_GOAL_SPREAD = 0.6
# The factor that answers the question, fixed before the pairs were drawn.
_FACTOR = 10.0
# Number of pairs of the long version.
_PAIRS_FULL = 400
# Seed by which they are drawn.
_SEED = 2027
# When their motions begin, in s.
_THINKING_TIME = 0.5
# Starts of the solver for a pair.
_STARTS = 2
# What the servos add to the rates of the plan, and to its largest deviation; shares.
_OVERSHOOT = 0.05
# How far the arm may be from its goal in the end, in rad.
_MISS = 1e-3
# What the servos, which lag behind the plan, have to leave of its clearance, in m.
_LEFT = 0.01
# By how much two simulations of one plan may differ: a share, and an angle in rad.
_SAME_SHARE = 0.05
_SAME_ANGLE = 2e-4


@dataclass(frozen=True)
class Outcome:
    """The numbers by which a motion of the arm in the full testbed is judged.

    Attributes:
        end: q, the deviation of the base's attitude at the end, in rad.
        largest: The largest deviation, in rad.
        integral: The integral of the deviation over time, in rad s.
        rate: The largest rate of a joint, as a share of its limit.
        torque: The largest torque of a drive, as a share of its limit.
        miss: The distance of the joints from the goal at the end, in rad.
        clearance: The least distance of the arm from base, panels and itself in m, by Drake.
        nearest: Between what this distance is.
    """

    end: float
    largest: float
    integral: float
    rate: float
    torque: float
    miss: float
    clearance: float
    nearest: str


@dataclass(frozen=True)
class Course:
    """A motion of the arm in the full testbed.

    Attributes:
        times: Times in s, shape (n,).
        deviations: Deviations of the base's attitude in rad, shape (n,).
        rates: The largest rate of each joint, as a share of its limit, shape (7,).
        torques: The largest torque of each drive, as a share of its limit, shape (7,).
        positions: Positions of the joints in rad, shape (n, 7).
        goal: Where they were to end, in rad, shape (7,).
    """

    times: Array
    deviations: Array
    rates: Array
    torques: Array
    positions: Array
    goal: Array

    @cached_property
    def outcome(self) -> Outcome:
        """Return the numbers by which the motion is judged."""
        clearance, nearest = min(map(_drake_clearance().nearest, self.positions))
        return Outcome(
            end=float(self.deviations[-1]),
            largest=float(self.deviations.max()),
            integral=float(np.trapezoid(self.deviations, self.times)),
            rate=float(self.rates.max()),
            torque=float(self.torques.max()),
            miss=float(np.max(np.abs(self.positions[-1] - self.goal))),
            clearance=clearance,
            nearest=nearest,
        )


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
    times = np.linspace(0.0, scenario.horizon, round(scenario.horizon / PERIOD) + 1)
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
        positions=q,
        goal=np.array(scenario.goal),
    )


@lru_cache(maxsize=1)
def _drake_clearance() -> DrakeClearance:
    return DrakeClearance()


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
    """Return random motions, whose ends are not in collision and whose straight paths keep the limits.

    Half of them go from poses near the stowed one to poses that reach forward, the others, every second one, from any
    pose to any.

    Args:
        count: Number of motions.
        seed: Seed of the random numbers.
    """
    random = np.random.default_rng(seed)
    kinds = _motions(lambda: _reaching(random)), _motions(lambda: _anywhere(random))
    return [next(kinds[k % 2]) for k in range(count)]


def _reaching(random: np.random.Generator) -> tuple[Array, Array]:
    start = Servicer().stowed + random.uniform(-_START_SPREAD, _START_SPREAD, ARM_JOINTS)
    return start, REACHING + random.uniform(-_GOAL_SPREAD, _GOAL_SPREAD, ARM_JOINTS)


def _anywhere(random: np.random.Generator) -> tuple[Array, Array]:
    start, goal = random.uniform(Servicer().lower, Servicer().upper, (2, ARM_JOINTS))
    return start, goal


def _motions(draw: Callable[[], tuple[Array, Array]]) -> Iterator[ArmMotionScenario]:
    """Yield the motions between drawn poses that are possible."""
    while True:
        start, goal = draw()
        scenario = ArmMotionScenario(start=start.tolist(), goal=goal.tolist(), thinking_time=_THINKING_TIME)
        try:
            scenario.validate()
        except ScenarioError:
            continue
        move = scenario.move()
        if not move.excess(move.straight):
            yield scenario


@dataclass(frozen=True)
class Comparison:
    """The straight path of a motion beside the best plan, both in the full testbed.

    Attributes:
        straight: The outcome on the straight path.
        best: The outcome on the best plan.
        touched: The limits that the plan uses up, by the momentum model, see `Move.touched`; not of a decision on
            board.
    """

    straight: Outcome
    best: Outcome
    touched: tuple[str, ...] = ()

    @staticmethod
    def of(stored: Mapping[str, Any]) -> Comparison:
        """Return what was kept."""
        return Comparison(Outcome(**stored["straight"]), Outcome(**stored["best"]), tuple(stored["touched"]))

    @property
    def factor(self) -> float:
        """Return the ratio of the deviations at the end, of the straight path over the best plan."""
        return self.straight.end / self.best.end

    @property
    def within_limits(self) -> bool:
        """Return whether rates, torques, the goal, the deviation on the way and the clearance are kept in the testbed.

        The clearance is judged by Drake's distances.
        """
        best = self.best
        arrives, clear = best.miss < _MISS, best.clearance >= _LEFT
        return max(best.rate, best.torque) <= 1.0 + _OVERSHOOT and arrives and clear and self.turns_within

    def __str__(self) -> str:
        straight, best = self.straight, self.best
        limits = "within" if self.within_limits else "EXCEEDS"
        return (
            f"{np.degrees(straight.end):6.2f} deg -> {np.degrees(best.end):6.3f} deg, factor {self.factor:7.1f}; "
            f"clearance {1e3 * best.clearance:5.1f} mm ({best.nearest}); {limits} the limits, uses up "
            f"{', '.join(self.touched) or 'none'}"
        )

    @property
    def turns_within(self) -> bool:
        """Return whether the deviation on the way is at most the straight path's."""
        return self.best.largest <= (1.0 + _OVERSHOOT) * self.straight.largest

    def agrees(self, other: Comparison) -> bool:
        """Return whether another comparison of the same motion is the same, but for rounding on another processor."""
        pairs = [
            (getattr(mine, name), getattr(its, name))
            for mine, its in ((self.straight, other.straight), (self.best, other.best))
            for name in ("end", "largest")
        ]
        same = all(abs(a - b) <= max(_SAME_SHARE * a, _SAME_ANGLE) for a, b in pairs)
        return same and self.within_limits == other.within_limits


@dataclass(frozen=True)
class Pair:
    """A random pair of start and goal.

    Attributes:
        number: Its place in `random_scenarios`; the even ones reach forward from near the stowed pose.
        start: Positions of the joints at the start in rad, (7,).
        goal: Their positions at the end in rad, (7,).
    """

    number: int
    start: tuple[float, ...]
    goal: tuple[float, ...]

    def __str__(self) -> str:
        return f"pair {self.number}"


def compare(scenario: ArmMotionScenario) -> Comparison:
    """Return the straight path beside the best plan by the momentum model, or that decided on board."""
    straight = simulate(replace(scenario, onboard=False)).outcome
    if scenario.onboard:
        return Comparison(straight, simulate(scenario).outcome)
    plan = plan_calmly(scenario.move(), attempts=_STARTS)
    return Comparison(straight, simulate(scenario, plan.knots).outcome, tuple(plan.move.touched(plan.knots)))


def compare_pair(pair: Pair) -> Comparison:
    """Return the comparison of a random pair."""
    return compare(ArmMotionScenario(start=list(pair.start), goal=list(pair.goal), thinking_time=_THINKING_TIME))


def random_pairs(count: int) -> list[Pair]:
    """Return the first random pairs of the application."""
    scenarios = random_scenarios(count, seed=_SEED)
    return [Pair(number, tuple(each.start), tuple(each.goal)) for number, each in enumerate(scenarios)]


@dataclass(frozen=True)
class Survey:
    """The results of plans for many motions, in the full testbed."""

    comparisons: tuple[Comparison, ...]

    @cached_property
    def factors(self) -> Array:
        """Return the factors, shape (n,)."""
        return np.array([comparison.factor for comparison in self.comparisons])

    @property
    def median(self) -> float:
        """Return the median factor."""
        return float(np.median(self.factors))

    @cached_property
    def interval(self) -> tuple[float, float]:
        """Return the 90 % interval of the median factor, by order statistics."""
        _, lower, upper = median(self.factors)
        return lower, upper

    @property
    def disturbance(self) -> dict[str, float]:
        """Return by how much the best plans change other measures of the deviation: median ratios to the straight path.

        Below 1 the plans are better.
        """
        pairs = [(comparison.best, comparison.straight) for comparison in self.comparisons]
        return {
            "largest": float(np.median([best.largest / straight.largest for best, straight in pairs])),
            "integral": float(np.median([best.integral / straight.integral for best, straight in pairs])),
        }

    @property
    def successes(self) -> int:
        """Return how many motions reach the factor of 10."""
        return int(np.sum(self.factors >= _FACTOR))

    @cached_property
    def share(self) -> tuple[float, float]:
        """Return the exact 90 % interval of the share of motions that reach the factor of 10."""
        from scipy.stats import binomtest

        interval = binomtest(self.successes, len(self.factors)).proportion_ci(0.9, method="exact")
        return float(interval.low), float(interval.high)

    @property
    def outside(self) -> list[Comparison]:
        """Return the comparisons whose plans exceed a limit."""
        return [comparison for comparison in self.comparisons if not comparison.within_limits]

    @property
    def holds(self) -> bool:
        """Return whether more than half of all motions reach the factor, and no plan exceeds a limit.

        More than half of all, not of these: the 90 % interval of the median lies above 10.
        """
        return self.interval[0] >= _FACTOR and not self.outside

    def __str__(self) -> str:
        least_clear = min((comparison.best for comparison in self.comparisons), key=lambda best: best.clearance)
        distance, pair = 1e3 * least_clear.clearance, least_clear.nearest
        ends = np.degrees([(comparison.straight.end, comparison.best.end) for comparison in self.comparisons])
        n, (lower, upper) = len(self.factors), self.interval
        least, most = (100.0 * share for share in self.share)
        (straight, best), worst = np.median(ends, axis=0), np.quantile(ends[:, 1], 0.9)
        touched = Counter(name for c in self.comparisons if c.factor < _FACTOR for name in c.touched or ("none",))
        limits = ", ".join(f"{name} {count}" for name, count in touched.most_common()) or "none"
        return (
            f"Of {n} random pairs of start and goal the median factor is {self.median:.0f} (90 %: {lower:.0f} to "
            f"{upper:.0f}); {self.successes} reach {_FACTOR:g} (90 %: {least:.0f} to {most:.0f} %). In the end the "
            f"base is off by {best:.3f} deg (median; at most {worst:.3f} in 90 %), on the straight path by "
            f"{straight:.2f}. {self._disturbed()}. Plans that exceed a limit: {len(self.outside)}; least clearance by "
            f"Drake {distance:.1f} mm, of {pair}. Limits that the plans below {_FACTOR:g} use up: {limits}."
        )

    def _disturbed(self) -> str:
        ratios = ", ".join(f"{name} {ratio:.2f}" for name, ratio in self.disturbance.items())
        return f"On the way, deviations over the straight path's (medians): {ratios}"


@dataclass(frozen=True)
class TrajectoryAnswer:
    """The plans for two kinds of motions, each with its verdict, and the decision on board.

    Attributes:
        reaching: Motions from near the stowed pose to the workspace, as before a capture.
        anywhere: Motions from any pose to any: farther, and with less room beside the limits.
        onboard: The motion that the DPS decides itself.
    """

    reaching: Survey
    anywhere: Survey
    onboard: Comparison

    @staticmethod
    def of(comparisons: Mapping[Pair, Comparison], onboard: Comparison) -> TrajectoryAnswer:
        """Return the answer from the comparisons of random pairs, and of the motion that is decided on board."""
        kinds = ([each for pair, each in comparisons.items() if pair.number % 2 == kind] for kind in (0, 1))
        reaching, anywhere = (Survey(tuple(kind)) for kind in kinds)
        return TrajectoryAnswer(reaching, anywhere, onboard)

    @property
    def holds(self) -> bool:
        """Return whether motions to a capture reach the factor, the others are better than straight, all within limits.

        The first kind is what the application asks for, the decision on board included. For the other kind the factor
        of 10 has a verdict of its own, `Survey.holds`, which the answer tells.
        """
        onboard = self.onboard.factor >= _FACTOR and self.onboard.within_limits
        return self.reaching.holds and self.anywhere.interval[0] > 1.0 and not self.anywhere.outside and onboard


def verdicts(reaching: Survey, anywhere: Survey) -> str:
    """Return the verdicts about the factor of 10 for two kinds of motions, in words.

    Args:
        reaching: Motions from near the stowed pose to the workspace.
        anywhere: Motions from any pose to any.
    """
    kinds = {"From near the stowed pose to the workspace": reaching, "From any pose to any": anywhere}
    return " ".join(
        f"{kind} (a factor of {_FACTOR:g} {'holds' if result.holds else 'is NOT shown'}): {result}"
        for kind, result in kinds.items()
    )


def kept_comparisons() -> dict[Pair, Comparison]:
    """Return the comparisons that are kept, by pair."""
    rows = read_results(RESULTS)["pairs"] if RESULTS.exists() else []
    return {Pair(row["number"], tuple(row["start"]), tuple(row["goal"])): Comparison.of(row) for row in rows}


def keep_comparisons(comparisons: Mapping[Pair, Comparison]) -> None:
    """Keep the comparisons of some pairs."""
    rows = [{**vars(pair), **vars(comparisons[pair])} for pair in sorted(comparisons, key=lambda pair: pair.number)]
    write_results(RESULTS, {"pairs": rows}, command=COMMAND)


def survey(count: int, *, echo: Callable[[str], Any] = lambda line: None, workers: int | None = None) -> Survey:
    """Return what the best plans by the momentum model make of the first random pairs, in the full testbed.

    Those that are not kept are planned and simulated in processes, and each is kept.

    Args:
        count: The number of pairs.
        echo: Gets a line for each new pair, in their order.
        workers: The number of processes; by default one per core.
    """
    pairs, comparisons = random_pairs(count), kept_comparisons()
    missing = [pair for pair in pairs if pair not in comparisons]
    for pair, comparison in in_processes(compare_pair, missing, workers=workers):
        comparisons[pair] = comparison
        keep_comparisons(comparisons)
        echo(f"{pair}: {comparison}")
    return Survey(tuple(comparisons[pair] for pair in pairs))


def answer(full: bool) -> Answer:
    """Answer R2: which trajectory of the arm disturbs the base least?

    The random pairs, and the captures that show what the plans are worth there, are read from files; a tenth of each is
    made again. The long version plans and simulates more pairs first, and keeps them.
    """
    if full:
        survey(_PAIRS_FULL)
    comparisons = kept_comparisons()
    repetitions = repeat("pairs", comparisons, compare_pair, Comparison.agrees), captures_again()
    result = TrajectoryAnswer.of(comparisons, compare(ArmMotionScenario(onboard=True)))
    onboard, anywhere = result.onboard, result.anywhere
    turned = np.degrees([onboard.straight.end, onboard.best.end])
    lower, upper = anywhere.interval
    return Answer(
        id="R2",
        question="Which trajectory of a service satellite's arm disturbs its base least?",
        answer=result.reaching.median,
        unit=(
            "times less rotation at the end than on the straight joint-space path (median, to a capture; "
            f"{anywhere.median:.0f}, {lower:.0f} to {upper:.0f}, from any pose to any)"
        ),
        interval=result.reaching.interval,
        paper="none given",
        cases="the momentum model, for each motion anew",
        held_out=f"the full testbed, {len(comparisons)} random motions and the one that the DPS decides on board",
        baseline="the straight path in joint space",
        holds=result.holds and all(repetition.same for repetition in repetitions),
        note=(
            f"In the full testbed: the DPS's decision on board turns the base by {turned[1]:.3f} deg instead of "
            f"{turned[0]:.2f} in the end, by {np.degrees(onboard.best.largest):.2f} instead of "
            f"{np.degrees(onboard.straight.largest):.2f} at most. {verdicts(result.reaching, anywhere)} "
            f"{PlannedCaptures(kept_captures()).sentence}. {'. '.join(map(str, repetitions))}."
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
        label = f"{name}: {np.degrees(course.outcome.end):.2f} deg in the end"
        axes.plot(course.times, np.degrees(course.deviations), label=label)
    axes.set(xlabel="time (s)", ylabel="rotation of the base (deg)")
    axes.legend()
    axes.grid(alpha=0.3)
    return figure


@click.command()
@click.argument("figure", default="arm_trajectory.png")
@click.option("--pairs", type=click.IntRange(min=10), help="Print what becomes of N random motions instead.")
@click.option("--workers", type=click.IntRange(min=1), help="Number of processes; by default one per core.")
def main(figure: str, pairs: int | None, workers: int | None) -> None:
    """Simulate the straight path and the decision on board, and write the plot FIGURE."""
    if pairs:
        everything = survey(pairs, echo=lambda line: click.echo(line, err=True), workers=workers)
        click.echo(str(everything))
        click.echo(verdicts(Survey(everything.comparisons[0::2]), Survey(everything.comparisons[1::2])))
        return
    scenario = ArmMotionScenario(onboard=True)
    courses = {"straight path": simulate(replace(scenario, onboard=False)), "decided on board": simulate(scenario)}
    plot(courses).savefig(figure, dpi=120)


if __name__ == "__main__":
    # Under its own name, so that kept pairs have one class.
    from vtbdrake_diagrams.satellite.studies.trajectory import main as program

    program(prog_name="python -m vtbdrake_diagrams.satellite.studies.trajectory")
