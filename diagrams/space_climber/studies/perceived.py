"""Application R1 from perception to action: the robot sees, builds its world, tries, acts, and looks again.

Before it starts, the robot has a survey from orbit, which is coarse and partly wrong (`survey`). At each stop it looks
around with its laser scanner, adds what it sees to its semantic world model, builds a mental world of that, tries
headings there from its belief (`explorer`), and walks `LEG` seconds in the best one. Slip that it felt on the way is
friction of the patches it walked on. Where it is blocked, it goes back as it came, remembers the place as an obstacle,
looks and decides again; if no heading gains much, it tries to walk backwards, too. It never sees the crater's seed, and
of the true terrain (`rover`) nothing but scans and its own motion.

``python -m vtbdrake_diagrams.space_climber.studies.perceived`` runs craters, and adds them to a file of results.
"""

from __future__ import annotations

import ast
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import date
from functools import cache, cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

import click
import numpy as np
from matplotlib.figure import Figure

from vtbdrake.compiled import Terrain
from vtbdrake_diagrams.space_climber.believed_terrain import BelievedTerrain
from vtbdrake_diagrams.space_climber.crater_scenario import PASSED, CraterScenario
from vtbdrake_diagrams.space_climber.route import CLEARANCE, route
from vtbdrake_diagrams.space_climber.standing_scanner import StandingScanner
from vtbdrake_diagrams.space_climber.studies.crater import HEADING, LIMIT, POSE, WALK, differing
from vtbdrake_diagrams.space_climber.studies.explorer import Explorer, Stop
from vtbdrake_diagrams.space_climber.studies.rover import (
    FEW_ROCKS,
    GROUNDS,
    SEGMENT,
    CompiledRover,
    Ground,
    Rover,
    terrain_of,
    true_world,
)
from vtbdrake_diagrams.space_climber.survey import survey
from vtbdrake_diagrams.space_climber.terrain import RIM_RADIUS

LEG = 20.0
"""How long the robot walks until it looks again, in s: 3.8 m on level ground."""

LOOKING = 5.0
"""How long it stands and looks, in s: until it stands, and one scan from then on."""

BLOCKED_WITHIN = 10.0
"""A robot that came less far than `BLOCKED_WAY` within this time, in s, is blocked."""

BLOCKED_WAY = 0.4
"""See `BLOCKED_WITHIN`; in m. On level ground it would be 1.9 m."""

GOING_BACK = 10.0
"""How long a blocked robot goes back, as it came, before it looks, in s: 1.6 m on level ground."""

BLOCKED_AHEAD = 0.6
"""How far ahead of its middle a blocked robot believes the obstacle to be, in m: beyond its front feet."""

HEADINGS = np.linspace(-LIMIT, LIMIT, 13)
"""Fixed headings in rad, 7.5 deg apart: a crater is passable if one passes; the least steep one is a strategy."""

SIDE_BY_SIDE = 3
"""How many fixed headings walk in one call, until one passes."""

FIXED_STRATEGIES = ("least slope", "straight")
LOOKING_STRATEGIES = ("reasoned", "perceived route")
STRATEGIES = ("reasoned", "surveyed route", "least slope", "straight", "perceived route")
COMPARED = STRATEGIES[:4]
"""The decision, and the baselines that it is compared with. The route over what is seen shows what trying adds."""

GROUND_BY_NAME = {ground.name: ground for ground in GROUNDS}

RESULTS = Path(__file__).with_name("perceived.jsonl")


@dataclass(frozen=True)
class Walk:
    """How a strategy ended in a crater.

    Attributes:
        seed: The crater's seed.
        strategy: One of `STRATEGIES`, or a fixed heading.
        reached: Whether the robot passed the rim.
        duration: Simulated time in s.
        end: (x, y, z) of the torso at the end, in m.
        reason: How the simulation ended.
        stops: The stops.
        thinking: Processor time in s of building and trying, over all stops.
        ground: The name of the crater's kind, one of `GROUNDS`.
    """

    seed: int
    strategy: str
    reached: bool
    duration: float
    end: tuple[float, float, float]
    reason: str
    stops: tuple[Stop, ...] = field(default=(), repr=False)
    thinking: float = 0.0
    ground: str = FEW_ROCKS.name


class Site:
    """A crater with the simulated reality and the survey of it, for all strategies.

    Attributes:
        seed: The crater's seed.
        ground: Its kind.
        world: The simulated reality.
        terrain: What is known before the robot looks.
    """

    def __init__(self, seed: int, ground: Ground = FEW_ROCKS, *, in_drake: bool = False) -> None:
        """Survey a crater.

        Args:
            seed: The crater's seed.
            ground: Its kind.
            in_drake: Whether Drake simulates the world, its scanner included, instead of `compiled_world`.
        """
        self.seed: int = seed
        self.ground: Ground = ground
        self._in_drake = in_drake
        self.world: CraterScenario = true_world(seed, ground)
        prior = survey(self.world.crater, seed=0)
        self.terrain: BelievedTerrain = BelievedTerrain(prior.ground, prior.rocks)

    @cached_property
    def _compiled_parts(self) -> tuple[Terrain, StandingScanner]:
        return terrain_of(self.world), StandingScanner(self.world.crater)

    def rover(self) -> Rover:
        """Return a robot that stands at the bottom."""
        mass = differing(self.seed, self.seed).mass
        if self._in_drake:
            return Rover(self.world.build(), mass=mass)
        return CompiledRover(self.world, *self._compiled_parts, mass=mass)

    def run(self, strategy: str) -> Walk:
        """Let a strategy of `STRATEGIES` find its way out.

        Raises:
            ValueError: There is no such strategy.
        """
        if strategy in FIXED_STRATEGIES:
            return self.fixed(self.heading_of(strategy), strategy)
        if strategy not in STRATEGIES:
            raise ValueError(f"a strategy is one of {', '.join(STRATEGIES)}, not {strategy!r}")
        return self.explore(strategy)

    def heading_of(self, strategy: str) -> float:
        """Return the heading (rad) of one of `FIXED_STRATEGIES`."""
        return least_slope(self.terrain) if strategy == "least slope" else 0.0

    def explore(self, strategy: str = "reasoned", *, draws: int = 0) -> Walk:
        """Let the robot find its way out with looking, or along the route over the survey.

        Args:
            strategy: ``reasoned`` tries headings, ``perceived route`` follows the route over what it sees, ``surveyed
                route`` that over the survey.
            draws: See `Explorer`.
        """
        rover = self.rover()
        explorer = Explorer(self.world, self.terrain, tries=strategy == "reasoned", draws=draws)
        way = route(self.terrain)
        stops: list[Stop] = []
        while not self._is_over(rover):
            if strategy not in LOOKING_STRATEGIES:
                x, y = rover.place.tolist()
                stops.append(Stop(rover.time, (x, y, 0.0), way.heading([x, y])))
                rover.advance(min(LEG, self.ground.longest - rover.time), heading=way.heading([x, y]), walk=1.0)
                continue
            rover.advance(LOOKING, walk=0.0)
            stops.append(explorer.decide(rover))
            if stops[-1].heading is None or self._is_over(rover):
                break
            self._leg(rover, explorer, stops[-1].heading, stops[-1].walk)
        return self._walk(strategy, rover, stops, explorer.thinking)

    def _leg(self, rover: Rover, explorer: Explorer, heading: float, walk: float) -> None:
        """Walk a leg; a robot that is blocked on its way goes back a little, as it came."""
        path, begun, blocked_by = [rover.place], rover.stepped, None
        within, end = round(BLOCKED_WITHIN / SEGMENT), rover.time + LEG
        while not self._is_over(rover, end) and blocked_by is None:
            rover.advance(SEGMENT, heading=heading, walk=walk)
            path.append(rover.place)
            if len(path) > within and np.linalg.norm(path[-1] - path[-1 - within]) < BLOCKED_WAY:
                blocked_by = rover.place + walk * BLOCKED_AHEAD * np.array([np.cos(rover.yaw), np.sin(rover.yaw)])
        explorer.felt(path, float(np.linalg.norm(rover.stepped - begun)), blocked_by=blocked_by)
        if blocked_by is not None:
            yaw, end = rover.yaw, rover.time + GOING_BACK
            while not self._is_over(rover, end):
                rover.advance(SEGMENT, heading=yaw, walk=-walk)

    def all_fixed(self, headings: Sequence[float]) -> list[Walk]:
        """Walk in each of the headings (rad) until the end, side by side in the compiled world."""
        if not headings:
            return []
        rover = self.rover()
        assert isinstance(rover, CompiledRover)
        rover.advance(LOOKING, walk=0.0)
        begin = rover.states([{HEADING: heading, WALK: 1.0} for heading in headings])
        z, ends, messages = rover.simulate(begin, rover.time, self.ground.longest - LOOKING)
        walks = []
        for heading, state, rover.ended, end in zip(headings, z, messages, ends, strict=True):
            rover.set_state(state, end)
            walks.append(self._walk(heading_name(heading), rover))
        return walks

    def fixed(self, heading: float, strategy: str = "") -> Walk:
        """Walk in one heading (rad) until the end."""
        rover = self.rover()
        rover.advance(LOOKING, walk=0.0)
        rover.advance(self.ground.longest - LOOKING, heading=heading, walk=1.0)
        return self._walk(strategy or heading_name(heading), rover)

    def _is_over(self, rover: Rover, end: float = np.inf) -> bool:
        return bool(rover.ended) or rover.time > min(end, self.ground.longest) - 0.5 * SEGMENT

    def _walk(self, strategy: str, rover: Rover, stops: Sequence[Stop] = (), thinking: float = 0.0) -> Walk:
        end = tuple(float(value) for value in rover.testbed.read(rover.context, POSE)[:3])
        reason = rover.ended or ("stands still: " + stops[-1].said if stops and stops[-1].heading is None else "time")
        return Walk(
            self.seed,
            strategy,
            PASSED in rover.ended,
            rover.time,
            end,
            reason,
            tuple(stops),
            thinking,
            self.ground.name,
        )


def heading_name(heading: float) -> str:
    """Return the name of the walk in one heading (rad), which is none of `STRATEGIES`."""
    return f"{np.degrees(heading):g} deg"


def least_slope(terrain: BelievedTerrain) -> float:
    """Return the heading in rad, of those at most 45 deg aside, along which the steepest place is the least steep."""
    return by_slope(terrain)[0]


def by_slope(terrain: BelievedTerrain) -> list[float]:
    """Return `HEADINGS`, sorted by how steep the steepest place along them is."""
    gradients, ground = terrain.slopes(), terrain.ground
    along = np.arange(1.0, RIM_RADIUS + 1.0)

    def steepest(heading: float) -> float:
        ways = along[:, None] * [np.cos(heading), np.sin(heading)]
        return float(np.hypot(*(ground.height(ways, gradient) for gradient in gradients)).max())

    return sorted(HEADINGS.tolist(), key=steepest)


@dataclass(frozen=True)
class Crossing:
    """All walks in one crater.

    Attributes:
        seed: The crater's seed.
        walks: The walks by the names of their strategies, and of fixed headings.
    """

    seed: int
    walks: Mapping[str, Walk]

    @property
    def passable(self) -> bool | None:
        """Return whether in the true world some fixed heading of `HEADINGS` reaches the rim; None: not known yet."""
        names = ["straight", "least slope", *map(heading_name, HEADINGS)]
        if any(self.walks[name].reached for name in names if name in self.walks):
            return True
        walked = {*self.walks, *([heading_name(0.0)] if "straight" in self.walks else [])}
        return False if walked.issuperset(map(heading_name, HEADINGS)) else None


def crossings(walks: Sequence[Walk], ground: Ground = FEW_ROCKS) -> tuple[Crossing, ...]:
    """Return walks on one kind of ground by crater, in the order of the seeds."""
    by_seed: dict[int, dict[str, Walk]] = {}
    for walk in walks:
        if walk.ground == ground.name:
            by_seed.setdefault(walk.seed, {})[walk.strategy] = walk
    return tuple(Crossing(seed, by_seed[seed]) for seed in sorted(by_seed))


def judged(walks: Sequence[Walk], ground: Ground = FEW_ROCKS) -> tuple[Crossing, ...]:
    """Return the passable craters of a kind, from its first seed on, in which all of `COMPARED` have walked."""
    return tuple(
        crossing
        for crossing in crossings(walks, ground)
        if crossing.seed >= ground.first_seed and crossing.passable and crossing.walks.keys() >= set(COMPARED)
    )


@cache
def digest() -> str:
    """Return what a result depends on, as a hash of the code of this module and of the testbed's that it imports.

    Docstrings and comments are not part of it.
    """
    text = "".join(
        f"{path.name}\n{code_without_docstrings(path)}\n" for path in imported_modules(Path(__file__).resolve())
    )
    return sha256(text.encode()).hexdigest()[:16]


def imported_modules(path: Path) -> list[Path]:
    """Return the files of a module and of the testbed's modules that it imports, directly or not, sorted.

    Args:
        path: A file of the testbed.
    """
    folder, package = Path(__file__).resolve().parents[1], __package__.rpartition(".")[0]
    files, todo = set(), {path}
    while todo:
        files |= todo
        nodes = [node for file in todo for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))]
        names = {name.name for node in nodes if isinstance(node, ast.Import) for name in node.names}
        for node in nodes:
            if isinstance(node, ast.ImportFrom) and node.module:
                # What is imported from a package may be a module.
                names |= {node.module, *(f"{node.module}.{name.name}" for name in node.names)}
        inside = [name.removeprefix(package).lstrip(".") for name in names if f"{name}.".startswith(f"{package}.")]
        places = [folder.joinpath(*name.split(".")) for name in inside]
        modules = {place.with_suffix(".py") for place in places}
        todo = {file for file in modules if file.is_file()} - files
    return sorted(files)


def code_without_docstrings(path: Path) -> str:
    """Return the code of a module without comments and docstrings, also of constants and attributes."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(body := getattr(node, "body", None), list):
            texts = [each for each in body if isinstance(each, ast.Expr) and isinstance(each.value, ast.Constant)]
            node.body = [each for each in body if each not in texts]
    return ast.unparse(tree)


def save(walk: Walk, path: Path = RESULTS) -> None:
    """Append a walk to a file, a line of JSON each, with the digest of the program and the date."""
    record = {"digest": digest(), "date": date.today().isoformat(), **asdict(walk)}
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(record) + "\n")


def load(path: Path = RESULTS) -> tuple[Walk, ...]:
    """Return the walks of a file; none if there is no file.

    Raises:
        ValueError: A line of the file is no walk.
    """
    if not path.exists():
        return ()
    walks = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            walks.append(_read_walk(json.loads(line)))
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"line {number} of {path} is no walk: {error!r}") from error
    return tuple(walks)


def older(path: Path = RESULTS) -> int:
    """Return how many walks of a file are by another version of the program, by its digest."""
    if not path.exists():
        return 0
    present, lines = digest(), path.read_text(encoding="utf-8").splitlines()
    return sum(json.loads(line).get("digest") != present for line in lines)


def _read_walk(record: Mapping[str, Any]) -> Walk:
    stops = tuple(
        Stop(**{**stop, "place": tuple(stop["place"]), "tried": tuple(map(tuple, stop["tried"]))})
        for stop in record["stops"]
    )
    values = {field.name: record[field.name] for field in fields(Walk)}
    return Walk(**{**values, "end": tuple(record["end"]), "stops": stops})


def draw(walk: Walk) -> Figure:
    """Draw a walk on the true crater: what was surveyed, where the robot stopped, and what it tried there.

    Args:
        walk: A walk with stops, from a file of results.
    """
    site = Site(walk.seed, GROUND_BY_NAME[walk.ground])
    crater, figure = site.world.crater, Figure(figsize=(8.0, 7.0), layout="constrained")
    axes = figure.add_subplot(xlabel="x in m", ylabel="y in m", aspect="equal")
    vertices = site.terrain.ground.vertices()
    shape = (*site.terrain.ground.survey.shape, 2)
    x, y = np.moveaxis(vertices.reshape(shape), -1, 0)
    lines = axes.contour(x, y, crater.height(x, y), levels=np.arange(0.5, 6.5, 0.5), cmap="copper", linewidths=0.7)
    axes.clabel(lines, fontsize=7)
    large = [block for block in crater.blocks if block.size[2] > 2.0 * CLEARANCE]
    axes.plot([b.x for b in large], [b.y for b in large], "k.", markersize=3, label="rocks higher than 0.1 m")
    listed = site.terrain.rocks.positions()
    axes.plot(*listed[:, :2].T, "s", color="tab:red", markersize=5, fillstyle="none", label="boulders of the survey")
    for stop in walk.stops:
        for heading, direction, gain in stop.tried:
            along = direction * np.array([np.cos(heading), np.sin(heading)])
            end = np.array(stop.place[:2]) + max(gain, 0.0) * along
            axes.plot(*np.column_stack([stop.place[:2], end]), color="tab:blue", alpha=0.4, linewidth=1.0)
    places = np.array([*(stop.place[:2] for stop in walk.stops), walk.end[:2]])
    axes.plot(*places.T, "o-", color="tab:blue", markersize=4, label="stops; tried headings, as long as they gain")
    axes.legend(loc="lower right", fontsize=8)
    axes.set_title(f"crater {walk.seed}: {_summary(walk)}", fontsize=9)
    return figure


def missing_walks(site: Site, walks: Sequence[Walk], strategies: Sequence[str] = COMPARED) -> Iterator[Walk]:
    """Yield the walks in a crater that are not among others: of strategies, and fixed ones until one passes.

    Args:
        site: The crater.
        walks: Walks that are there, in this and other craters.
        strategies: The strategies.
    """
    key = (site.seed, site.ground.name)
    there = {walk.strategy: walk for walk in walks if (walk.seed, walk.ground) == key}
    fixed = {name: site.heading_of(name) for name in strategies if name in FIXED_STRATEGIES and name not in there}
    for name, walk in zip(fixed, site.all_fixed(list(fixed.values())), strict=True):
        there[name] = replace(walk, strategy=name)
        yield there[name]
    for name in [name for name in strategies if name not in there]:
        there[name] = site.run(name)
        yield there[name]
    # Straight on is one of the fixed headings. Some walk side by side, the most promising ones first.
    open_ = [each for each in by_slope(site.terrain) if each and heading_name(each) not in there]
    while open_ and Crossing(site.seed, there).passable is None:
        for walk in site.all_fixed(open_[:SIDE_BY_SIDE]):
            there[walk.strategy] = walk
            yield walk
        open_ = open_[SIDE_BY_SIDE:]


@click.command()
@click.option("--ground", "kind", type=click.Choice([*GROUND_BY_NAME]), default=FEW_ROCKS.name, show_default=True)
@click.option("--first", default=None, type=int, help="Seed of the first crater, by default the first that is judged.")
@click.option("--count", default=1, show_default=True, help="Number of craters.")
@click.option("--file", default=str(RESULTS), show_default=True, help="File of results, to which walks are added.")
@click.option("--figure", default="", help="File of a picture of the first crater's reasoned walk, if there is one.")
@click.option("--strategy", "strategies", multiple=True, default=COMPARED, show_default=True, help="What to compare.")
def main(kind: str, first: int | None, count: int, file: str, figure: str, strategies: tuple[str, ...]) -> None:
    """Let the robot find its way out of craters, and compare strategies; walks of the file are not repeated."""
    path, ground = Path(file), GROUND_BY_NAME[kind]
    begin = ground.first_seed if first is None else first
    for seed in range(begin, begin + count):
        for walk in missing_walks(Site(seed, ground), load(path), strategies):
            save(walk, path)
        crossing = next(each for each in crossings(load(path), ground) if each.seed == seed)
        for name, walk in crossing.walks.items():
            click.echo(f"crater {seed}, {name}: {_summary(walk)}")
    if figure:
        walks = next(each.walks for each in crossings(load(path), ground) if each.seed == begin)
        if "reasoned" in walks:
            draw(walks["reasoned"]).savefig(figure, dpi=110)
    cases = judged(load(path), ground)
    for strategy in COMPARED:
        reached = sum(case.walks[strategy].reached for case in cases)
        click.echo(f"{strategy}: the rim in {reached} of {len(cases)} passable craters with {ground.name}")


def _summary(walk: Walk) -> str:
    x, y, _ = walk.end
    end = (
        f"the rim in {walk.duration:.0f} s" if walk.reached else f"{np.hypot(x, y):.0f} m from the axis, {walk.reason}"
    )
    thought = f", {len(walk.stops)} stops, {walk.thinking:.0f} s of thinking" if walk.stops else ""
    return end + thought


if __name__ == "__main__":
    # Under its own name, so that its functions can be pickled.
    from vtbdrake_diagrams.space_climber.studies.perceived import main as program

    program(prog_name="python -m vtbdrake_diagrams.space_climber.studies.perceived")
