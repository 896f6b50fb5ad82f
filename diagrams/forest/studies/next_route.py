"""A carrier chooses the next route, to be localized best, by simulating all of them; true drives check its choice.

A storm has left gaps in a stand, where the carrier detects no trees and has its odometry only. The unit is localized on
a remote map, and chooses among the routes: the reasoner simulates each in a mental copy, whose forest is the map of the
DPS, and takes the one along which the expected error of the position is least.

To check the choice, every route is driven in the true forest once, and the detections of the DPS are recorded, with the
odometry. On these drives, units localize with many surveys of the same forest: with the map in use, by which the
carrier has chosen, and with `SURVEYS` others, which the choice did not use.

``python -m vtbdrake_diagrams.forest.studies.next_route [--forests N]`` prints, for each forest, the expected and the
true errors of all routes, and in the end the gains of the choices. The criteria were fixed before any forest from
`SEED` on was driven:

* The error of a route is the root mean square of the error of the position over the last `COUNTED` s of its drive and
  over the other surveys. With one map, it is a single draw of that map's errors, and draws differ by more than routes.
  The choice cannot profit from properties of the map in use alone, such as the trees that this map lacks by chance. Its
  gain with the map in use, one draw per forest, is printed, too.
* The error of a scan is at most `UNKNOWN`, and `UNKNOWN` without a pose.
* The gain of a forest is the error of the route in use, or the mean error of all routes, less the error of the chosen
  one. Its standard error is that over the forests.
* A carrier that is not localized after `FOUND` s cannot choose. Its forest is printed, and left out.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import click
import numpy as np
from threadpoolctl import threadpool_limits

import vtbdrake as vtb
from vtbdrake.cli.output import table
from vtbdrake.common.arrays import Array
from vtbdrake.components.localization.unit import TRACKING
from vtbdrake.components.world_model import WorldModel
from vtbdrake.reasoning import Decision, Reasoner
from vtbdrake.testbed import ScenarioError
from vtbdrake_diagrams.forest.scenario import ForestScenario
from vtbdrake_diagrams.forest.studies.drive import Track, localize, recorded_drive
from vtbdrake_diagrams.forest.world.stand import MAPS, MapErrors, Stand

SEED = 410_000
"""The seed of the first forest. Forests from 400,000 on were driven before, with clusters instead of gaps."""
ROUTE = "u.route"
COVARIANCE = "dps.env.pose.covariance"
FOUND = 3.0
"""The time of the decision in s: most carriers are localized by then."""
HORIZON = 40.0
"""The horizon of the mental rollouts, in s."""
COUNTED = 25.0
"""The time in s at the end of the horizon in which the quality counts: the routes have parted by then."""
SURVEYS = 8
"""The number of surveys of the forest by which routes are compared, beside the map in use."""
SAMPLE_PERIOD = 0.5
TIME_LIMIT = 600.0
"""The longest time that one rollout may take, in s: on an idle core, it takes about a third of the horizon."""
UNKNOWN = 2.0
"""The deviation and the error of a carrier without a pose, in m [assumed]."""


@dataclass(frozen=True)
class MappedStand(Stand):
    """A stand as a map shows it: the trees have the positions and sizes of the map.

    Attributes:
        errors: The name of the errors of the map, see `MAPS`.
        map_seed: Determines these errors, together with the seed of the stand.
    """

    errors: str = "accurate"
    map_seed: int = 0

    def trees(self) -> WorldModel:
        fields_of_stand = {item.name: getattr(self, item.name) for item in fields(Stand)}
        return Stand(**fields_of_stand).map(MAPS[self.errors], seed=self.map_seed)


@dataclass
class RouteScenario(ForestScenario):
    """A carrier in a stand with gaps of a storm that can decide where to drive next."""

    stand_kind: str = "windthrown"
    density: float = 600.0
    map: str = "remote"
    speed: float = 2.0
    # Whether the simulated forest is the map's, without clutter, as in a mental copy.
    is_imagined: bool = field(default=False, kw_only=True)

    def validate(self) -> None:
        super().validate()
        if self.map_file:
            raise ScenarioError(
                f"RouteScenario.map_file must be empty, not {self.map_file!r}: what the carrier imagines is grown from "
                "the seed"
            )

    def mental(self) -> RouteScenario:
        """Return the scenario that the carrier simulates when it reasons."""
        values_by_name = {item.name: getattr(self, item.name) for item in fields(self)}
        return RouteScenario(
            **{**values_by_name, "is_imagined": True, "undergrowth": 0.0, "branches": 0.0, "lean": 0.0}
        )

    def stand(self) -> Stand:
        true = super().stand()
        if not self.is_imagined:
            return true
        fields_of_stand = {item.name: getattr(true, item.name) for item in fields(Stand)}
        return MappedStand(**fields_of_stand, errors=self.map, map_seed=self.map_seed)

    def surveyed_map(self, errors: MapErrors) -> WorldModel:
        return super().stand().map(errors, seed=self.map_seed)


def variance(time: float, covariance: Array) -> float:
    """Return the expected square of the error of the position in m^2, in the plane; 0 before the time that counts.

    Args:
        time: The time in s.
        covariance: The covariance of the pose, (3, 3); infinite without a pose.
    """
    return min(float(covariance[0, 0] + covariance[1, 1]), UNKNOWN**2) if time >= FOUND + HORIZON - COUNTED else 0.0


def route_reasoner(scenario: RouteScenario) -> Reasoner:
    """Return the reasoner of the carrier, which decides on the next route."""
    count = len(scenario.routes())
    return Reasoner(
        scenario=scenario,
        decision=[vtb.Choice(ROUTE, [float(number) for number in range(count)])],
        quality=vtb.Quality(variance, of=["time", COVARIANCE], reading="integral", minimize=True),
        horizon=HORIZON,
        sample_period=SAMPLE_PERIOD,
        budget=vtb.Budget(rollouts=count + 1),
        search=vtb.SearchConfig(method="grid", time_limit=TIME_LIMIT),
    )


@dataclass(frozen=True)
class RouteAnswer:
    """A decision, and the errors along every route.

    Attributes:
        decision: The decision of the carrier.
        expected: The expected error along each route in the mental copy, in m, root mean square, shape (n,).
        by_map: The errors in the true forest in m, with the map in use first, and with each other survey, shape (k, n).
        in_use: The number of the route that was in use.
    """

    decision: Decision
    expected: Array
    by_map: Array
    in_use: int = 0

    @property
    def errors(self) -> Array:
        """The error of each route in m, root mean square over the other surveys, shape (n,)."""
        root_mean_squares: Array = np.sqrt(np.square(self.by_map[1:]).mean(axis=0))
        return root_mean_squares

    @property
    def choice(self) -> int:
        """The number of the route that was chosen; the number of the route in use if the decision sets none."""
        return round(float(self.decision.values.get(ROUTE, self.in_use)))

    @property
    def rank(self) -> int:
        """The number of routes with a smaller error than the chosen one."""
        return int((self.errors < self.errors[self.choice]).sum())


def route_scenario(seed: int) -> RouteScenario:
    """Return the carrier in the forest of a seed, with sensors whose noise has this seed, too."""
    scenario = RouteScenario(seed=seed)
    for errors in (scenario.scanner_errors, scenario.imu_errors, scenario.odometry_errors):
        errors.seed = seed
    return scenario


def decide_and_drive(seed: int) -> RouteAnswer | None:
    """Let the carrier decide in the forest of a seed, and drive every route there; None if it is not localized."""
    scenario = route_scenario(seed)
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.simulator(context).AdvanceTo(FOUND)
    if testbed.read(context, "dps.env.pose.status") != TRACKING:
        return None
    with route_reasoner(scenario) as reasoner:
        decision = reasoner.decide(testbed, context)
    expected = np.full(len(scenario.routes()), np.nan)
    # The plan in use, the first candidate, sets nothing: the carrier stays on its route.
    for candidate in decision.candidates:
        if candidate.rollouts:
            number = round(float(candidate.values.get(ROUTE, scenario.route)))
            expected[number] = (candidate.rollouts[0].value / COUNTED) ** 0.5
    return RouteAnswer(decision, expected, errors_by_map(scenario), scenario.route)


def errors_by_map(scenario: RouteScenario) -> Array:
    """Return the error of each route with the map in use, and with each of the other surveys, (1 + `SURVEYS`, n)."""
    numbers, length = range(len(scenario.routes())), scenario.speed * (FOUND + HORIZON)
    # One thread: matrices are small.
    with threadpool_limits(1):
        drives = [recorded_drive(replace(scenario, route=number), length=length) for number in numbers]
        surveys = [replace(scenario, map_seed=scenario.map_seed + k) for k in range(1 + SURVEYS)]
        units = [survey.unit(survey.global_map()) for survey in surveys]
        return np.array([[late_error(localize(drive, unit)) for drive in drives] for unit in units])


def late_error(track: Track) -> float:
    """Return the root mean square of the error of the position over the last `COUNTED` s of a drive, in m."""
    late = track.drive.times > track.drive.times[-1] - COUNTED
    errors = np.hypot(*(track.poses - track.drive.truth)[late, :2].T)
    counted = np.where(track.is_localized[late], np.minimum(errors, UNKNOWN), UNKNOWN)
    return float(np.sqrt(np.square(counted).mean()))


def summary(answers: dict[int, RouteAnswer]) -> str:
    """Return the gains of the choices in the forests of these seeds, as text: a table, gains and standard errors."""
    heads = ("forest", "expected m", "chosen m", "in use m", "all m", "best m", "better routes")
    rows = np.array([
        [
            answer.expected[answer.choice],
            answer.errors[answer.choice],
            answer.errors[answer.in_use],
            answer.errors.mean(),
            answer.errors.min(),
        ]
        for answer in answers.values()
    ])  # fmt: skip
    ranks = [answer.rank for answer in answers.values()]
    names, counts = [*map(str, answers), "mean"], [*map(str, ranks), f"{np.mean(ranks):.1f}"]
    lines = [
        (name, *(f"{value:.3f}" for value in row), rank)
        for name, row, rank in zip(names, [*rows, rows.mean(axis=0)], counts, strict=True)
    ]
    text = [table(heads, lines)]
    for name, column in (("the route in use", 2), ("the mean of all routes", 3)):
        text.append(f"gain over {name}: {_mean(rows[:, column] - rows[:, 1])}")
    gains = np.array([answer.by_map[0, answer.in_use] - answer.by_map[0, answer.choice] for answer in answers.values()])
    text.append(f"gain over the route in use with the map in use: {_mean(gains)}")
    promised = np.mean([answer.expected[answer.in_use] - answer.expected[answer.choice] for answer in answers.values()])
    text.append(f"expected gain over the route in use: {promised:.3f} m")
    return "\n".join(text)


def _mean(values: Array) -> str:
    spread = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.nan
    return f"{values.mean():.3f} m, with a standard error of {spread:.3f} m"


@click.command(context_settings={"show_default": True})
@click.option("--forests", default=12, help="Number of forests.")
@click.option("--seed", "first", default=SEED, help="Seed of the first forest.")
def main(forests: int, first: int) -> None:
    """Decide in some forests, and print the expected and the true errors."""
    answers = {}
    for seed in range(first, first + forests):
        answer = decide_and_drive(seed)
        if answer is None:
            print(f"forest {seed}: the carrier is not localized after {FOUND:g} s\n", flush=True)
            continue
        answers[seed] = answer
        rows = [
            (f"{number}{' (chosen)' if number == answer.choice else ''}", f"{expected:.3f}", f"{error:.3f}")
            for number, (expected, error) in enumerate(zip(answer.expected, answer.errors, strict=True))
        ]
        print(table(("route", "expected m", "error m"), rows))
        print(f"forest {seed}: {answer.rank} routes would have been better\n", flush=True)
    if answers:
        print(summary(answers))


if __name__ == "__main__":
    # Under its own name, so that worker processes find its functions.
    from vtbdrake_diagrams.forest.studies.next_route import main as program

    program()
