"""The simulated reality of question R1: craters of two kinds, and the robot that walks there, in Drake or compiled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.analysis import SimulatorConfig

from vtbdrake.common.arrays import Array
from vtbdrake.common.scan import Scan
from vtbdrake.compiled import CompiledRollouts, FixedPiece, Terrain
from vtbdrake.testbed import VirtualTestbed
from vtbdrake_diagrams.space_climber.believed_terrain import BelievedTerrain
from vtbdrake_diagrams.space_climber.crater_scenario import ENDS, X_BL, CraterScenario
from vtbdrake_diagrams.space_climber.morphology import Morphology
from vtbdrake_diagrams.space_climber.standing_scanner import StandingScanner
from vtbdrake_diagrams.space_climber.studies.crater import HEADING, MASS, POSE, WALK, differing
from vtbdrake_diagrams.space_climber.terrain import crater_shapes

SEGMENT = 5.0
"""The time that one call simulates of the reality, in s."""


@dataclass(frozen=True)
class Ground:
    """A kind of craters in which strategies are compared.

    Attributes:
        name: Its name.
        rock_cover: The share of the ground that rocks cover; see `terrain`.
        longest: The longest time that a robot may take, its stops included, in s.
        first_seed: Craters from this seed on are judged; those below were looked at.
    """

    name: str
    rock_cover: float
    longest: float
    first_seed: int


FEW_ROCKS = Ground("few rocks", rock_cover=0.03, longest=600.0, first_seed=1300)
"""Craters with the rock cover of the least rocky landing sites. Without a detour the way takes a little more than
300 s, so there is time for one. With 450 s, as it was for craters below 1300, walks were cut that still gained; see
docs/crater.md."""

MANY_ROCKS = Ground("many rocks", rock_cover=0.07, longest=900.0, first_seed=1500)
"""Craters with more rocks than the least rocky landing sites, and fewer than the rockiest; see `terrain`. There is time
for two detours, as was chosen in craters 1000 to 1031."""

GROUNDS = (FEW_ROCKS, MANY_ROCKS)


def true_world(seed: int, ground: Ground = FEW_ROCKS) -> CraterScenario:
    """Return the simulated reality of a crater: friction and mass differ from what is usual, and its ground is wavy."""
    return replace(
        differing(seed, seed).scenario,
        rock_cover=ground.rock_cover,
        scans=True,
        simulator_config=SimulatorConfig(),
        plant_config=MultibodyPlantConfig(
            time_step=0.02,
            contact_model="point",
            discrete_contact_approximation="sap",
            # What contact switches see is then compiled, too.
            use_sampled_output_ports=False,
        ),
    )


class Rover:
    """The robot in the simulated reality, with what it has in its own sensors and estimates.

    Attributes:
        testbed: The simulated reality.
        context: Its state.
        ended: The message with which the simulation ended; empty while it goes on.
    """

    def __init__(self, testbed: VirtualTestbed, *, mass: float) -> None:
        self.testbed = testbed
        self.context = testbed.default_context()
        testbed.write(self.context, {WALK: 0.0, MASS: mass * testbed.read(self.context, MASS)})
        self._simulator = testbed.simulator(self.context)
        self.ended: str = ""

    @property
    def time(self) -> float:
        """Return the simulated time in s."""
        return float(self.context.get_time())

    @property
    def place(self) -> Array:
        """Return where the robot believes to be, (x, y) in m."""
        place: Array = np.array(self.testbed.read(self.context, "dps.impl.navigator.position"))
        return place

    @property
    def yaw(self) -> float:
        """Return the believed azimuth of the robot's x axis in rad."""
        return float(self.testbed.read(self.context, "dps.env.yaw"))

    @property
    def stepped(self) -> Array:
        """Return where its legs have stepped to, (x, y) in m: leg odometry."""
        stepped: Array = np.array(self.testbed.read(self.context, "dps.env.position"))[:2]
        return stepped

    def X_WL(self, terrain: BelievedTerrain) -> RigidTransform:
        """Return the believed pose of the scanner: the elevation is the believed ground's plus the legs' height."""
        rpy = [float(self.testbed.read(self.context, f"dps.env.{name}")) for name in ("roll", "pitch", "yaw")]
        height = float(self.testbed.read(self.context, "dps.env.position")[2])
        place = self.place
        z = float(terrain.ground.height([place])[0]) + height
        return RigidTransform(RollPitchYaw(rpy), [*place, z]) @ X_BL

    def scan(self) -> Scan:
        """Return the last complete scan."""
        scanner = self.testbed.diagram.GetSubsystemByName("sim.sense.scanner")
        scan: Scan = scanner.GetOutputPort("scan").Eval(scanner.GetMyContextFromRoot(self.context))
        return scan

    def advance(self, duration: float, **commands: float) -> None:
        """Give commands, and go on for a time in s, or to the end of the simulation."""
        self.testbed.write(self.context, {f"u.{name}": value for name, value in commands.items()})
        status = self._simulator.AdvanceTo(self.time + duration)
        if status.reason() == status.ReturnReason.kReachedTerminationCondition:
            message = status.FormatMessage()
            self.ended = next((end for end in ENDS if end in message), message)


class CompiledRover(Rover):
    """The same robot in the same world, which is compiled once for all craters; the crater is data.

    It scans when it is asked, as if it had stood still before.

    Args:
        world: The simulated reality.
        terrain: Its ground and boulders.
        scanner: What looks at them.
        mass: Factor of the torso's mass.
    """

    def __init__(self, world: CraterScenario, terrain: Terrain, scanner: StandingScanner, *, mass: float) -> None:
        self.testbed, self._rollouts = compiled_world()
        self._terrain, self._scanner = terrain, scanner
        self.context = self.testbed.default_context()
        pose = np.array(self.testbed.read(self.context, POSE))
        # As high over the highest place under its feet as in the testbed that was compiled.
        pose[2] += _lowest_start(world) - _lowest_start(self.testbed.scenario)
        self.testbed.write(self.context, {WALK: 0.0, MASS: mass * self.testbed.read(self.context, MASS), POSE: pose})
        self.ended: str = ""

    def scan(self) -> Scan:
        pose = np.array(self.testbed.read(self.context, POSE))
        return self._scanner.scan(RigidTransform(RollPitchYaw(pose[3:]), pose[:3]), self.time)

    def advance(self, duration: float, **commands: float) -> None:
        self.testbed.write(self.context, {f"u.{name}": value for name, value in commands.items()})
        (z,), (end,), (self.ended,) = self.simulate(self.states([{}]), self.time, duration)
        self.set_state(z, end)

    def set_state(self, z: Array, time: float) -> None:
        """Set the state to a vector of state and parameters, and the time (s)."""
        self._rollouts.walker.write(z, self.context)
        self.context.SetTime(time)

    def states(self, values: Sequence[Mapping[str, float]]) -> Array:
        """Return the vectors of state and parameters with values by address, a row for each mapping."""
        rows = []
        for each in values:
            self.testbed.write(self.context, each)
            rows.append(self._rollouts.walker.read(self.context))
        return np.array(rows)

    def simulate(self, z: Array, begin: float, duration: float) -> tuple[Array, list[float], list[str]]:
        """Return the states at the end of walks, when they ended (s), and the messages of those that ended early.

        Args:
            z: The states at the begin, shape (n, nz).
            begin: The time at the begin in s.
            duration: How long they go on at most, in s.
        """
        self._rollouts.stand_on(self._terrain)
        z, now, finish = z.copy(), begin, begin + duration
        under_way, ends, messages = np.arange(len(z)), np.full(len(z), finish), [""] * len(z)
        while len(under_way) and now < finish - 0.5 * SEGMENT:
            batch = self._rollouts.from_z(z[under_way], now)
            z[under_way] = batch.final
            for row, k in enumerate(under_way.tolist()):
                if not batch.valid[row]:
                    messages[k], ends[k] = f"{NOT_COMPILED}: {batch.reasons[row]}", now
                elif batch.messages[row]:
                    messages[k] = next(end for end in ENDS if end in batch.messages[row])
                    ends[k] = now + batch.ends[row]
            now = self._rollouts.schedule_at(now)[-1].time
            under_way = np.array([k for k in under_way if not messages[k]], dtype=int)
        ends[under_way] = now
        return z, ends.tolist(), messages


NOT_COMPILED = "the compiled world does not hold"
"""A walk that ends so is none: the world has to be simulated in Drake."""


@cache
def compiled_world() -> tuple[VirtualTestbed, CompiledRollouts]:
    """Return a testbed of the simulated reality, and its compiled rollouts, which stand on any crater."""
    testbed = replace(true_world(0), scans=False, boulders=False, rock_cover=0.0).build()
    rollouts = testbed.compiled(horizon=SEGMENT, sample_period=SEGMENT, parameters=[HEADING, WALK, MASS], check=False)
    return testbed, rollouts


def terrain_of(world: CraterScenario) -> Terrain:
    """Return ground and boulders of a world for `compiled_world`, with its friction of feet and ground."""
    testbed, rollouts = compiled_world()
    feet = testbed.scenario.friction
    ground = combined_friction(world.friction, feet)
    return rollouts.terrain([FixedPiece(shape, X_WS, ground) for _, shape, X_WS in crater_shapes(world.crater)])


def combined_friction(friction: float, feet: float) -> float:
    """Return the friction b of ground that makes a given one with feet of the friction a: Drake has 2 a b / (a + b)."""
    return friction * feet / (2.0 * feet - friction)


def _lowest_start(world: CraterScenario) -> float:
    return float(world.crater.mesh_height(Morphology().stance[:, :2]).max())
