"""Where should the carrier drive next to be localized best? It asks its own testbed, and the true forest answers.

A stand of clusters has places where many trees are on the map and places with few. The unit has found itself on a
remote map, and chooses among the routes: the reasoner simulates each in a mental copy, whose forest is the map of the
DPS, and takes the one along which the DPS would know its position best. Then every route is driven in the true forest,
from the same state, and the errors tell whether the choice was good.

``python -m vtbdrake_diagrams.forest.next_route [--forests N]`` prints, for each forest, the expected deviations and the
errors of all routes, and in the end what the choices have gained. What counts was fixed before the first result was
seen: the mean over the last `COUNTED` s.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

import vtbdrake as vtb
from vtbdrake.cli.output import table
from vtbdrake.components.world_model import WorldModel
from vtbdrake.reasoning import Decision, Reasoner
from vtbdrake_diagrams.forest.scanner_choice import COMPARED, distance_off
from vtbdrake_diagrams.forest.scenario import ForestScenario
from vtbdrake_diagrams.forest.stand import MAPS, Stand

Array = NDArray[np.float64]

SEED = 400_000
ROUTE = "u.route"
COVARIANCE = "dps.env.pose.covariance"
FOUND = 3.0
"""The time in s at which the carrier is asked: it has found itself by then."""
HORIZON = 40.0
"""The horizon of the mental rollouts, in s."""
COUNTED = 25.0
"""The quality counts in so many seconds at the end of the horizon: the routes have parted by then."""
SAMPLE_PERIOD = 0.5
TIME_LIMIT = 600.0
"""The longest time that one rollout may take, in s: on an idle core, it takes about a third of the horizon."""
UNKNOWN = 2.0
"""The deviation and the error of a carrier without a pose, in m [assumed]."""


@dataclass(frozen=True)
class MappedStand(Stand):
    """A stand as a map shows it: the trees are where the map has them.

    Attributes:
        errors: The name of the errors of the map, see `MAPS`.
        map_seed: Determines these errors, together with the seed of the stand.
    """

    errors: str = "accurate"
    map_seed: int = 0

    def trees(self) -> WorldModel:
        own = {item.name: getattr(self, item.name) for item in fields(Stand)}
        return Stand(**own).map(MAPS[self.errors], seed=self.map_seed)


@dataclass
class RouteScenario(ForestScenario):
    """A carrier in a clustered stand that may think about where to drive next."""

    stand_kind: str = "clustered"
    density: float = 300.0
    map: str = "remote"
    speed: float = 2.0
    # Whether the simulated forest is that of the map, without clutter: what the carrier imagines.
    is_imagined: bool = field(default=False, kw_only=True)

    def validate(self) -> None:
        super().validate()
        self.require(map_file=(not self.map_file, "empty: what the carrier imagines is grown from the seed"))

    def mental(self) -> RouteScenario:
        """Return what the carrier simulates when it reasons."""
        own = {item.name: getattr(self, item.name) for item in fields(self)}
        return RouteScenario(**{**own, "is_imagined": True, "undergrowth": 0.0, "branches": 0.0, "lean": 0.0})

    def stand(self) -> Stand:
        true = super().stand()
        if not self.is_imagined:
            return true
        own = {item.name: getattr(true, item.name) for item in fields(Stand)}
        return MappedStand(**own, errors=self.map, map_seed=self.map_seed)

    def surveyed_map(self) -> WorldModel:
        return super().stand().map(MAPS[self.map], seed=self.map_seed)


def deviation(time: float, covariance: Array) -> float:
    """Return the standard deviation of the position in m, in the plane; 0 before the time that counts.

    Args:
        time: In s.
        covariance: Of the pose, (3, 3); infinite without a pose.
    """
    if time < FOUND + HORIZON - COUNTED:
        return 0.0
    variance = float(covariance[0, 0] + covariance[1, 1])
    return min(variance**0.5, UNKNOWN) if np.isfinite(variance) else UNKNOWN


def route_reasoner(scenario: RouteScenario, **options: Any) -> Reasoner:
    """Return the reasoner of the carrier, which decides on the next route."""
    count = len(scenario.routes())
    return Reasoner(
        scenario=scenario,
        decision=[vtb.Choice(ROUTE, [float(number) for number in range(count)])],
        quality=vtb.Quality(deviation, of=["time", COVARIANCE], reading="integral", minimize=True),
        horizon=HORIZON,
        sample_period=SAMPLE_PERIOD,
        method="grid",
        budget=vtb.Budget(rollouts=count + 1),
        time_limit=TIME_LIMIT,
        **options,
    )


@dataclass(frozen=True)
class RouteAnswer:
    """A decision, and what came of every route.

    Attributes:
        decision: The carrier's.
        expected: The mean deviation of the position along each route in its mind, in m, shape (n,).
        errors: The root mean square error of the position along each route in the true forest, in m, shape (n,).
        in_use: The number of the route that was in use.
    """

    decision: Decision
    expected: Array
    errors: Array
    in_use: int = 0

    @property
    def chosen(self) -> int:
        """The number of the route that was chosen; that in use if nothing is set."""
        return round(float(self.decision.values.get(ROUTE, self.in_use)))

    @property
    def rank(self) -> int:
        """How many routes have a smaller error than the one that was chosen."""
        return int((self.errors < self.errors[self.chosen]).sum())


def decide_and_drive(seed: int) -> RouteAnswer:
    """Let the carrier decide in the forest of a seed, and drive every route in the true forest.

    Raises:
        ValueError: The carrier has not found itself: it has no belief.
    """
    scenario = RouteScenario(seed=seed)
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.simulator(context).AdvanceTo(FOUND)
    with route_reasoner(scenario) as reasoner:
        decision = reasoner.decide(testbed, context)
    start = testbed.snapshot(context)
    problem = vtb.Problem(
        scenario=scenario,
        parameters=[vtb.Parameter(ROUTE, 0.0, len(scenario.routes()) - 1.0)],
        quality=vtb.Quality(squared_error, of=COMPARED, reading="integral", minimize=True),
        horizon=HORIZON,
        sample_period=SAMPLE_PERIOD,
        start=start,
    )
    numbers = range(len(scenario.routes()))
    sweep = problem.sweep(values=[(float(number),) for number in numbers], progress=False)
    expected = np.full(len(numbers), np.nan)
    # The plan in use, the first candidate, sets nothing: the carrier stays on its route.
    for candidate in decision.candidates:
        if candidate.rollouts:
            expected[round(float(candidate.values.get(ROUTE, scenario.route)))] = candidate.rollouts[0].value / COUNTED
    errors = np.sqrt([rollout.value / COUNTED for rollout in sweep.rollouts])
    return RouteAnswer(decision, expected, errors, scenario.route)


def summary(answers: dict[int, RouteAnswer]) -> str:
    """Return what the choices have gained in the forests of these seeds, as text: a table, gains and spreads."""
    heads = ("forest", "expected m", "chosen m", "in use m", "all m", "best m", "better routes")
    rows = np.array([
        [one.expected[one.chosen], one.errors[one.chosen], one.errors[one.in_use], one.errors.mean(), one.errors.min()]
        for one in answers.values()
    ])  # fmt: skip
    ranks = [one.rank for one in answers.values()]
    names, counts = [*map(str, answers), "mean"], [*map(str, ranks), f"{np.mean(ranks):.1f}"]
    lines = [
        (name, *(f"{value:.3f}" for value in row), rank)
        for name, row, rank in zip(names, [*rows, rows.mean(axis=0)], counts, strict=True)
    ]
    text = [table(heads, lines)]
    for name, column in (("the route in use", 2), ("the mean of all routes", 3)):
        gains = rows[:, column] - rows[:, 1]
        spread = gains.std(ddof=1) / np.sqrt(len(gains)) if len(gains) > 1 else np.nan
        text.append(f"gain over {name}: {gains.mean():.3f} m, with a standard error of {spread:.3f} m")
    promised = np.mean([one.expected[one.in_use] - one.expected[one.chosen] for one in answers.values()])
    text.append(f"expected gain over the route in use: {promised:.3f} m")
    for name, values in (("errors", "errors"), ("expected deviations", "expected")):
        spreads = np.mean([np.var(getattr(one, values)) for one in answers.values()]) ** 0.5
        text.append(f"standard deviation of the {name} of the routes of a forest: {spreads:.3f} m")
    return "\n".join(text)


def squared_error(time: float, position: Array, told: float, truth: Array, velocity: Array) -> float:
    """Return the square of `distance_off` in m^2; 0 before the time that counts, and `UNKNOWN` squared at most."""
    if time < FOUND + HORIZON - COUNTED:
        return 0.0
    error = distance_off(time, position, told, truth, velocity)
    return min(error, UNKNOWN) ** 2 if np.isfinite(error) else UNKNOWN**2


def main() -> None:
    """Decide in some forests, and print what was expected and what came."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--forests", type=int, default=1)
    parser.add_argument("--seed", type=int, default=SEED)
    chosen = parser.parse_args()
    answers = {}
    for seed in range(chosen.seed, chosen.seed + chosen.forests):
        answers[seed] = found = decide_and_drive(seed)
        rows = [
            (f"{number}{' (chosen)' if number == found.chosen else ''}", f"{expected:.3f}", f"{error:.3f}")
            for number, (expected, error) in enumerate(zip(found.expected, found.errors, strict=True))
        ]
        print(table(("route", "expected m", "error m"), rows))
        print(f"forest {seed}: {found.rank} routes would have been better\n", flush=True)
    print(summary(answers))


if __name__ == "__main__":
    # Under its own name, so that worker processes find its functions.
    from vtbdrake_diagrams.forest.next_route import main as program

    program()
