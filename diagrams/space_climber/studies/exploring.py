"""The climber that finds its way out of a crater on board: its DPS perceives, builds its world, tries, and acts.

`perceived` judges the decisions in many craters, with a robot that is told from outside when to look and to walk. Here
the same `Explorer` is a slow part of the DPS, ``head``: ``pilot`` stands, asks it, walks a leg or notices that it is
blocked, and stands again. The DPS has its sensor signals, the scanner's among them, the survey, and the command
``explore``. So it is the same in a simulation and beside a loop, where ``head`` works in a process of its own.

``python -m vtbdrake_diagrams.space_climber.studies.exploring --seed N`` simulates it in Drake, and prints what it
decides.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from enum import IntEnum
from typing import Any

import click
import numpy as np
from drake import lcmt_scope
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, DiscreteValues
from scipy import sparse

from vtbdrake.common.arrays import Array
from vtbdrake.common.scan import Scan
from vtbdrake.components.world_model.world_model import WORLD_MODEL_CODEC
from vtbdrake.control.fallback import Hold
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.maps import vector_map
from vtbdrake.lcm.protocol import Protocol
from vtbdrake.lcm.sensor_messages import scan_map
from vtbdrake.state import AddressedSystem, Codec, Quantity
from vtbdrake.testbed import Interface, ScenarioError, Signal, SlowPart, VirtualTestbed, VirtualTestbedBuilder
from vtbdrake.testbed.dps_state import DpsState
from vtbdrake_diagrams.space_climber.believed_terrain import BelievedTerrain
from vtbdrake_diagrams.space_climber.crater_scenario import ENDS, PASSED, CraterScenario, scanner_config
from vtbdrake_diagrams.space_climber.dps import add_walker
from vtbdrake_diagrams.space_climber.ground_map import GroundMap
from vtbdrake_diagrams.space_climber.studies.crater import MASS, POSE, differing
from vtbdrake_diagrams.space_climber.studies.explorer import Explorer, mental_reasoner
from vtbdrake_diagrams.space_climber.studies.perceived import (
    BLOCKED_AHEAD,
    BLOCKED_WAY,
    BLOCKED_WITHIN,
    GOING_BACK,
    LEG,
    LOOKING,
)
from vtbdrake_diagrams.space_climber.studies.rover import FEW_ROCKS, SEGMENT, Rover, true_world
from vtbdrake_diagrams.space_climber.survey import survey

PERIOD = 0.2
"""Period of ``pilot`` and ``head`` in s."""

STEP = 0.1
"""The largest distance of a first command from the measured joints, in rad."""

LATENCY = 3.0
"""Time from a request to its decision, in s."""

# Places of a leg that are kept, and the number of segments in which a robot that is not blocked gets on.
_PLACES = round(LEG / SEGMENT) + 1
_WITHIN = round(BLOCKED_WITHIN / SEGMENT)
# The niceness of the process in which ``head`` works beside a loop.
_NICENESS = 5
# All heads of a process have one mental world, which each decision puts elsewhere.
_taking_turns = threading.Lock()
# Times that differ by less are equal, in s.
_ROUNDING = 1e-6


class Phase(IntEnum):
    """The states of a `Pilot`."""

    LOOK = 0
    ASK = 1
    WALK = 2
    BACK = 3


class Pilot(AddressedSystem):
    """A system that lets the robot stand, asks where to go, and lets it walk there for a while.

    .. pydrake_system::

        name: Pilot
        input_ports:
        - pose
        - navigation
        - explore
        - decision
        - sampled_at
        - missed
        output_ports:
        - heading
        - walk
        - request
        - leg

    ``pose`` and ``navigation`` are the walker's estimates. While ``explore`` is 0 the robot stands. ``decision`` is
    [heading (rad), walk, 1 to go or 0 to stand]; ``sampled_at`` and ``missed`` are those ports of the slow part that
    makes it. After a decision that is late, or is to stand, the robot looks and asks again. A robot that is blocked on
    its way goes back a little, as it came. ``leg`` tells of the last leg: the number of its places, whether it was
    blocked, (x, y) of the obstacle (m), the way that the legs stepped (m), and the places (x, y) (m).
    """

    def __init__(self) -> None:
        super().__init__()
        sizes = {"pose": 6, "navigation": 12, "explore": 1, "decision": 3, "sampled_at": 1, "missed": 1}
        for name, size in sizes.items():
            self.DeclareVectorInputPort(name, size)
        count, point = Quantity(0.0), Quantity([0.0, 0.0], "m")
        self.phase = self.declare_discrete_state(
            phase=Quantity(float(Phase.LOOK)), since=Quantity(0.0, "s"), late=count, begun=point
        )
        self.heading = self.declare_discrete_state(heading=Quantity(0.0, "rad"))
        self.walk = self.declare_discrete_state(walk=Quantity(0.0, bounds=(-1.0, 1.0)))
        self.request = self.declare_discrete_state(request=count)
        self.leg = self.declare_discrete_state(
            places=count,
            blocked=Quantity(0.0, bounds=(0.0, 1.0)),
            obstacle=point,
            stepped=Quantity(0.0, "m"),
            path=Quantity(np.zeros((_PLACES, 2)), "m"),
        )
        for name in ("heading", "walk", "request", "leg"):
            self.DeclareStateOutputPort(name, getattr(self, name).index)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self._step)

    def _input(self, name: str, context: Context) -> Array:
        value: Array = self.GetInputPort(name).Eval(context)
        return value

    def _step(self, context: Context, state: DiscreteValues) -> None:
        phase = self.phase.mutable(state)
        elapsed = context.get_time() - phase.since + _ROUNDING
        if not self._input("explore", context)[0]:
            self._look(context, state)
        elif phase.phase == Phase.LOOK and elapsed >= LOOKING:
            phase.phase, phase.since, phase.late = Phase.ASK, context.get_time(), self._input("missed", context)[0]
            self.request.mutable(state).request += 1.0
        elif phase.phase == Phase.ASK:
            self._await(context, state)
        elif phase.phase == Phase.WALK:
            self._go_on(context, state, elapsed)
        elif phase.phase == Phase.BACK and elapsed >= GOING_BACK:
            self._look(context, state)

    def _look(self, context: Context, state: DiscreteValues) -> None:
        phase = self.phase.mutable(state)
        phase.phase, phase.since, self.walk.mutable(state).walk = Phase.LOOK, context.get_time(), 0.0

    def _await(self, context: Context, state: DiscreteValues) -> None:
        phase, leg = self.phase.mutable(state), self.leg.mutable(state)
        heading, walk, goes = self._input("decision", context)
        is_there = self._input("sampled_at", context)[0] > phase.since - _ROUNDING
        if is_there and goes:
            self.heading.mutable(state).heading, self.walk.mutable(state).walk = heading, walk
            phase.phase, phase.since, phase.begun = Phase.WALK, context.get_time(), self._input("pose", context)[3:5]
            leg.places, leg.blocked, leg.path[0] = 1.0, 0.0, self._input("navigation", context)[:2]
        elif is_there or self._input("missed", context)[0] > phase.late:
            leg.places = 0.0  # What it tells has been taken.
            self._look(context, state)

    def _go_on(self, context: Context, state: DiscreteValues, elapsed: float) -> None:
        phase, leg = self.phase.mutable(state), self.leg.mutable(state)
        if elapsed < leg.places * SEGMENT:
            return
        pose, count = self._input("pose", context), int(leg.places)
        leg.path[count] = place = self._input("navigation", context)[:2]
        leg.places, leg.stepped = count + 1.0, float(np.linalg.norm(pose[3:5] - phase.begun))
        if count >= _WITHIN and np.linalg.norm(place - leg.path[count - _WITHIN]) < BLOCKED_WAY:
            walk = self.walk.mutable(state)
            ahead = walk.walk * BLOCKED_AHEAD * np.array([np.cos(pose[2]), np.sin(pose[2])])
            leg.blocked, leg.obstacle = 1.0, place + ahead
            self.heading.mutable(state).heading, walk.walk = pose[2], -walk.walk
            phase.phase, phase.since = Phase.BACK, context.get_time()
        elif count + 1 == _PLACES:
            self._look(context, state)


class Head:
    """The function of the slow part ``head``: looks, builds the mental world, tries headings there, and decides.

    Its memory is the believed terrain. All of it is in the arguments of the call.
    """

    def prepare(self) -> None:
        """Compile the mental world before the first decision, in a process that leaves the processors to the loop."""
        os.nice(_NICENESS)
        reasoner, *_ = mental_reasoner()
        reasoner.warm_up()

    def __call__(
        self, *, scan: Scan, leg: Array, request: Array, dps: DpsState, memory: BelievedTerrain
    ) -> tuple[dict[str, Array], BelievedTerrain]:
        """Return [heading (rad), walk, whether to go], what that gains in m, and what is believed then.

        Args:
            scan: The last scan.
            leg: The output ``leg`` of `Pilot`.
            request: The request; its value does not matter.
            dps: The state of the DPS.
            memory: What is believed of the terrain.
        """
        reasoner, *_, scenario = mental_reasoner()
        explorer = Explorer(scenario, memory)
        places, blocked, obstacle, stepped = int(leg[0]), leg[1], leg[2:4], float(leg[4])
        if places > 1:
            explorer.felt(list(leg[5:].reshape(-1, 2)[:places]), stepped, blocked_by=obstacle if blocked else None)
        with _taking_turns:
            stop = explorer.decide(_SampledRover(reasoner.problem.testbed, dps, scan))
        goes = stop.heading is not None
        gains = [gain for heading, walk, gain in stop.tried if (heading, walk) == (stop.heading, stop.walk)]
        outputs = {
            "decision": np.array([stop.heading if goes else 0.0, stop.walk, float(goes)]),
            "gain": np.array(gains or [np.nan]),
        }
        return outputs, explorer.terrain


class _SampledRover(Rover):
    """The robot as its DPS has sampled itself: a context of the mental testbed with the state of the walker.

    Args:
        mental: The mental testbed, whose DPS is the walker alone.
        dps: The state of the DPS.
        scan: The last scan.
    """

    def __init__(self, mental: VirtualTestbed, dps: DpsState, scan: Scan) -> None:
        self.testbed, self.context, self.ended = mental, mental.default_context(), ""
        self.context.SetTime(dps.time)
        mental.dps_layout.put(self.context, mental.dps_layout.part_of(dps.contents))
        self._scan = scan

    def scan(self) -> Scan:
        return self._scan


def _encode(terrain: BelievedTerrain) -> dict[str, Array]:
    ground, information = terrain.ground, terrain.ground.information
    return {
        "grid": np.array([*ground.origin, ground.cell, ground.deviation, ground.range]),
        "survey": ground.survey,
        "moment": ground.moment,
        **{f"information.{name}": getattr(information, name) for name in ("data", "indices", "indptr")},
        **{f"rocks.{name}": array for name, array in WORLD_MODEL_CODEC.encode(terrain.rocks).items()},
        **{name: getattr(terrain, name) for name in ("friction", "friction_variance", "obstacles")},
    }


def _decode(arrays: Mapping[str, Array]) -> BelievedTerrain:
    x, y, cell, deviation, reach = arrays["grid"].tolist()
    n = arrays["survey"].size
    parts = tuple(arrays[f"information.{name}"].copy() for name in ("data", "indices", "indptr"))
    information = sparse.csr_matrix(parts, shape=(n, n))
    ground = GroundMap((x, y), cell, arrays["survey"], deviation, reach, information, arrays["moment"])
    rocks = {name.removeprefix("rocks."): array for name, array in arrays.items() if name.startswith("rocks.")}
    felt = {name: arrays[name] for name in ("friction", "friction_variance", "obstacles")}
    return BelievedTerrain(ground, WORLD_MODEL_CODEC.decode(rocks), **felt)


# What is believed of the terrain as arrays and back, exact to the last bit.
TERRAIN_CODEC = Codec(_encode, _decode)


def _plant_config() -> MultibodyPlantConfig:
    return true_world(0).plant_config


@dataclass
class ExploringScenario(CraterScenario):
    """A six-legged robot that finds its way out of a `Crater`: it looks around, tries headings in mind, and walks."""

    # Discrete steps, as in the worlds of `perceived`.
    simulator_config: SimulatorConfig = field(default_factory=SimulatorConfig)
    plant_config: MultibodyPlantConfig = field(default_factory=_plant_config)
    rock_cover: float = FEW_ROCKS.rock_cover
    scans: bool = True

    @classmethod
    def in_world(cls, world: CraterScenario) -> ExploringScenario:
        """Return the robot in a world that a scenario describes."""
        values = {each.name: getattr(world, each.name) for each in fields(world)}
        return cls(**{**values, "scans": True})

    def validate(self) -> None:
        super().validate()
        if not self.scans:
            raise ScenarioError("ExploringScenario.scans must be True, not False: the robot decides by what it sees")

    def interface(self) -> Interface:
        walker = super().interface()
        scan = Signal("scan", model_value=Scan.empty(), max_age=5.0 / scanner_config().frequency)
        explore = Signal("explore", size=1, values=(0.0, 1.0), default=1.0)
        return Interface(sense=[*walker.sense, scan], act=walker.act, commands=[explore])

    def deployment(self) -> Deployment:
        """Return how the DPS runs on the robot: after a fault it holds its joints."""
        scan_period = 1.0 / scanner_config().frequency
        acting = "joint_position_acting"
        vectors = ("visual_odometry", "imu", "foot_contact", acting, "joint_encoders")
        return Deployment(
            protocol=Protocol(
                sense=[
                    scan_map("SCAN", "scan"),
                    *(vector_map(name.upper(), lcmt_scope, {name: "value"}) for name in vectors),
                ],
                act=[vector_map("JOINT_COMMAND", lcmt_scope, {"joint_position": "value"})],
                reported={"joint_position": acting},
                commands=[vector_map("EXPLORE", lcmt_scope, {"explore": "value"})],
                periods={"SCAN": scan_period, "VISUAL_ODOMETRY": self._odometer_period},
            ),
            period=self.period,
            guards={"fallback": {"joint_position": Hold()}},
            continuity={"joint_position": ("joint_encoders", STEP)},
        )

    def make_dps(self) -> Diagram:
        prior = survey(self.crater, seed=0)
        builder = DiagramBuilder()
        impl = add_walker(builder, self.gait, period=self.period, clearance=self.clearance, navigator=True)
        env = builder.GetSubsystemByName("env")
        pilot = builder.AddNamedSystem("pilot", Pilot())
        head = SlowPart(
            Head(),
            inputs={"scan": Scan.empty(), "leg": pilot.GetOutputPort("leg").size()},
            outputs={"decision": 3, "gain": 1},
            period=PERIOD,
            latency=LATENCY,
            initial={"gain": np.array([np.nan])},
            memory=BelievedTerrain(prior.ground, prior.rocks),
            codecs={"memory": TERRAIN_CODEC},
            on_request=True,
            samples_dps=True,
        )
        builder.AddNamedSystem("head", head)
        builder.Connect(env.GetOutputPort("pose"), pilot.GetInputPort("pose"))
        builder.Connect(impl.GetOutputPort("navigation"), pilot.GetInputPort("navigation"))
        for name in ("decision", "sampled_at", "missed"):
            builder.Connect(head.GetOutputPort(name), pilot.GetInputPort(name))
        for name in ("leg", "request"):
            builder.Connect(pilot.GetOutputPort(name), head.GetInputPort(name))
        for name in ("heading", "walk"):
            builder.Connect(pilot.GetOutputPort(name), impl.GetInputPort(name))
        builder.ExportInput(impl.GetInputPort("visual_odometry"), "visual_odometry")
        builder.ExportInput(head.GetInputPort("scan"), "scan")
        builder.ExportInput(pilot.GetInputPort("explore"), "explore")
        dps = builder.Build()
        dps.set_name("dps")
        return dps

    def _add_scanner(self, builder: VirtualTestbedBuilder) -> Any:
        scanner = super()._add_scanner(builder)
        builder.sim_sensor("scan", scanner.GetOutputPort("scan"))
        return scanner


@dataclass(frozen=True)
class Exploration:
    """The outcome of one exploration of a crater.

    Attributes:
        seed: The crater's seed.
        end: How the simulation ended; empty if the time was over.
        duration: Simulated time in s.
        decisions: The number of decisions.
        wall_time: How long it took to simulate and to decide, in s.
    """

    seed: int
    end: str
    duration: float
    decisions: int
    wall_time: float

    @property
    def reached(self) -> bool:
        """Return whether the robot has passed the rim."""
        return self.end == PASSED


def explore(seed: int, *, seconds: float = FEW_ROCKS.longest, echo: Callable[[str], Any] = print) -> Exploration:
    """Let the robot find its way out of a crater of `perceived`, in Drake.

    Args:
        seed: The crater's seed.
        seconds: How long it may take, in s.
        echo: Gets a line for each decision.
    """
    begin, testbed = time.perf_counter(), ExploringScenario.in_world(true_world(seed)).build()
    context = testbed.default_context()
    testbed.write(context, {MASS: differing(seed, seed).mass * testbed.read(context, MASS)})
    simulator, shown, count, end = testbed.simulator(context), -np.inf, 0, ""
    while not end and context.get_time() < seconds - _ROUNDING:
        status = simulator.AdvanceTo(min(context.get_time() + PERIOD, seconds))
        if (sampled_at := float(testbed.read(context, "dps.head.sampled_at"))) > shown:
            shown, count = sampled_at, count + 1
            echo(f"{sampled_at:6.1f} s: {_decision(testbed, context)}")
        if status.reason() == status.ReturnReason.kReachedTerminationCondition:
            message = status.FormatMessage()
            end = next((each for each in ENDS if each in message), message)
    return Exploration(seed, end, float(context.get_time()), count, time.perf_counter() - begin)


def _decision(testbed: VirtualTestbed, context: Context) -> str:
    heading, walk, goes = testbed.read(context, "dps.head.decision")
    x, y, z = testbed.read(context, POSE)[:3]
    gain = float(testbed.read(context, "dps.head.gain"))
    decided = f"{'ahead' if walk > 0 else 'back'} at {np.degrees(heading):.0f} deg, which gains {gain:.1f} m"
    return f"at ({x:.1f}, {y:.1f}, {z:.1f}) m: {decided if goes else 'stand'}"


@click.command()
@click.option("--seed", default=1000, show_default=True, help="Seed of the first crater.")
@click.option("--count", default=1, show_default=True, help="Number of craters.")
@click.option("--seconds", default=FEW_ROCKS.longest, show_default=True, help="How long the robot may take, in s.")
@click.option("--quiet", is_flag=True, help="Do not print the decisions.")
def main(seed: int, count: int, seconds: float, quiet: bool) -> None:
    """Let the robot find its way out of craters in Drake, and print what its DPS decides."""
    reached = 0
    for number in range(seed, seed + count):
        result = explore(number, seconds=seconds, echo=(lambda _: None) if quiet else click.echo)
        reached += result.reached
        click.echo(
            f"crater {number}: {result.end or 'time'} after {result.duration:.0f} s and {result.decisions} decisions; "
            f"simulated and decided in {result.wall_time:.0f} s"
        )
    click.echo(f"the rim in {reached} of {count} craters")


if __name__ == "__main__":
    # Under its own name, so that its functions can be pickled.
    from vtbdrake_diagrams.space_climber.studies.exploring import main as program

    program(prog_name="python -m vtbdrake_diagrams.space_climber.studies.exploring")
