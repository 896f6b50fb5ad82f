"""The SpaceClimber on the floor of a crater, and what it simulates when it reasons about a way out."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Self

import casadi
import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import BodyIndex, FixedOffsetFrame
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import Context, Diagram, DiscreteValues, EventStatus

from vtbdrake.common.settings import setting
from vtbdrake.compiled import At, Equations
from vtbdrake.components.casadi_system.rotations import roll_pitch_yaw_angles
from vtbdrake.components.sensors import ErrorModel
from vtbdrake.components.sensors.laser_scanner import LaserScannerConfig
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.testbed import Interface, ScenarioError, Signal, VirtualTestbedBuilder
from vtbdrake_diagrams.packed_system import Expression
from vtbdrake_diagrams.space_climber.dps import make_dps
from vtbdrake_diagrams.space_climber.morphology import Morphology
from vtbdrake_diagrams.space_climber.navigation import VisualOdometer
from vtbdrake_diagrams.space_climber.scenario import SpaceClimberScenario
from vtbdrake_diagrams.space_climber.terrain import RIM_RADIUS, Crater, add_crater

if TYPE_CHECKING:
    from vtbdrake.components.sensors.laser_scanner import LaserScanner

PAST_RIM = 1.5
"""How far beyond the rim the robot's centre ends a climb, in m: all of the robot is past it."""

PROGRESS = 0.5
"""How far a robot that is under way gets at least within its patience, in m: a tenth of what it walks in 30 s."""

PASSED = "the robot has passed the rim"
"""The message of a simulation that ends there."""

TIPPED = "the robot has tipped over"
"""The message of a simulation in which it has."""

STUCK = "the robot is stuck"
"""The message of a simulation in which it has come no further for its patience."""

ENDS = (PASSED, TIPPED, STUCK)
"""How a climb may end."""

FASTEST = 2.0
"""The most that the visual odometer measures, in m/s: twenty times as fast as the robot walks."""

TIPPED_OVER = np.radians(60.0)
"""From which roll or pitch on the robot has tipped over."""


SCANNER_NOISE = 0.012
"""Standard deviation of a range in m; see `scanner_config`."""

X_BL = RigidTransform(RollPitchYaw(0.0, np.radians(15.0), 0.0), [0.35, 0.0, 0.45])
"""Pose of the scanner on the torso: on a mast, 0.65 m over the ground, tilted down by 15 deg."""


def scanner_config() -> LaserScannerConfig:
    """Return a nodding line scanner: the numbers of a SICK LMS111, 50 lines per second, a point every 0.5 deg, 20 m.

    The 120 deg in front are used of each line. The mount nods over 50 deg in two seconds.
    """
    return LaserScannerConfig(
        frequency=0.5,
        rays_per_second=12_000.0,
        azimuth=np.radians(120.0),
        elevation=np.radians(50.0),
        rows=0,
        max_range=60.0,
        reflectivity=0.12,
    )


def _cenic() -> SimulatorConfig:
    return SimulatorConfig(integration_scheme="cenic", max_step_size=0.045, accuracy=1e-3)


@dataclass
class CraterScenario(SpaceClimberScenario):
    """A six-legged robot in a `Crater` that it has to leave; ``u.walk`` starts it in the direction ``u.heading``.

    A simulation ends when the robot has passed the rim, or has tipped over by 60 deg: only its feet collide, so that
    what follows would mean nothing.
    """

    # The samples of the DPS end every step, so that the largest step only has to be longer than their period.
    simulator_config: SimulatorConfig = field(default_factory=_cenic)
    # Static and dynamic friction of feet and ground: the middle of what friction angles of 24 to 37 deg give.
    friction: float = 0.6
    # The DPS runs at the period at which it can simulate itself fast enough when it reasons, because its copy starts
    # from its state.
    period: float = 0.04
    payload: bool = False
    clearance: float = setting(
        0.1,
        "Clearance of the swinging feet: boulders and kinks that are lower do not stop the robot.",
        unit="m",
        ge=0.0,
        le=0.15,
    )
    # The crater, see `Crater`.
    seed: int = setting(0, ge=0)
    gullies: bool = True
    boulders: bool = True
    waviness: float = setting(0.0, unit="m", ge=0.0, le=0.1)
    waviness_seed: int = setting(0, ge=0)
    rock_cover: float = setting(
        0.0, "Share of the ground that rocks cover, beside the fields of boulders.", ge=0.0, le=0.2
    )
    scans: bool = setting(False, "Whether a laser scanner on a mast looks at the terrain in front of the robot.")
    patience: float = setting(
        0.0,
        "A simulation ends when the robot has come no further from the axis (by `PROGRESS`) for so long; 0: never.",
        unit="s",
        ge=0.0,
    )

    def validate(self) -> None:
        super().validate()
        if self.slope_deg != 0.0:
            raise ScenarioError(
                f"CraterScenario.slope_deg must be 0, not {self.slope_deg!r}: the crater's ground has slopes of its own"
            )

    @property
    def crater(self) -> Crater:
        """Return the ground."""
        return Crater(
            self.seed,
            gullies=self.gullies,
            boulders=self.boulders,
            waviness=self.waviness,
            waviness_seed=self.waviness_seed,
            rock_cover=self.rock_cover,
        )

    def mental(self) -> Self:
        """Return what the robot simulates when it reasons: a map without waves, and a faster integrator.

        Drake's discrete SAP solver at the DPS's own period slips where a fine integrator does; CENIC at loose
        accuracies and the lagged approximation climb slopes that are steeper than friction allows.
        """
        return replace(
            self,
            simulator_config=SimulatorConfig(),
            plant_config=MultibodyPlantConfig(
                time_step=self.period,
                contact_model="point",
                discrete_contact_approximation="sap",
                # The contact switches see the present state, as they do in the world: not the step before.
                use_sampled_output_ports=False,
            ),
            waviness=0.0,
        )

    def interface(self) -> Interface:
        legs = super().interface()
        age = 5 * self._odometer_period
        eyes = Signal("visual_odometry", size=3, unit="m/s", lower=-FASTEST, upper=FASTEST, max_age=age)
        return replace(legs, sense=[*legs.sense, eyes])

    @property
    def _odometer_period(self) -> float:
        return 10 * self.period

    def make_dps(self) -> Diagram:
        return make_dps(self.gait, period=self.period, clearance=self.clearance, navigator=True)

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        super().add_world(builder)
        assert builder.plant is not None
        base = builder.plant.GetBodyByName("base").index()
        errors = ErrorModel(noise=0.01)
        builder.add_sensor("visual_odometry", VisualOdometer(base, period=self._odometer_period, errors=errors))
        monitor = builder.add("env", "climb", EndOfClimb(base, period=10 * self.period, patience=self.patience))
        builder.connect(builder.plant.GetOutputPort("body_poses"), monitor.get_input_port())
        if self.scans:
            self._add_scanner(builder)

    def _add_scanner(self, builder: VirtualTestbedBuilder) -> LaserScanner:
        # Imported here: without the scanner, the testbed needs no Embree.
        from vtbdrake.components.ray_casting import RayCaster
        from vtbdrake.components.sensors.laser_scanner import LaserScanner, connect_laser_scanner

        plant = builder.plant
        assert plant is not None
        # What it sees of the robot itself is left out, as a filter would.
        base = plant.GetBodyByName("base")
        frame = plant.GetFrameByName("scanner")
        robot = [plant.get_body(index) for index in plant.GetBodyIndices(base.model_instance())]
        caster = RayCaster(plant, builder.scene_graph, without=robot)
        config, errors = scanner_config(), ErrorModel(noise=SCANNER_NOISE)
        scanner = LaserScanner(plant, frame, caster, config=config, slice_period=0.2, errors=errors)
        builder.add("sense", "scanner", scanner)
        connect_laser_scanner(builder.diagram_builder, scanner, plant)
        return scanner

    def _add_ground(self, plant: MultibodyPlant) -> RigidTransform:
        crater = self.crater
        add_crater(plant, crater)
        if self.scans:
            plant.AddFrame(FixedOffsetFrame("scanner", plant.GetBodyByName("base").body_frame(), X_BL))
        # Level, on the highest of the places under its feet: no foot begins in the ground.
        return RigidTransform([0.0, 0.0, float(crater.mesh_height(Morphology().stance[:, :2]).max())])

    def _declare_belief(self, builder: VirtualTestbedBuilder) -> None:
        """Declare what the robot believes; the elevation is its map's plus its height over the ground."""
        ground = self.crater.height
        place = ["dps.impl.navigator.position", "dps.env.position[2]"]
        self._believe_base(builder, place, lambda p, height: [*p, height + float(ground(*p))])
        self._believe_joints(builder)


class EndOfClimb(AddressedSystem):
    """A system that ends the simulation when the robot has passed the rim, has tipped over, or is stuck.

    .. pydrake_system::

        name: EndOfClimb
        input_ports:
        - body_poses

    Attributes:
        base: Index of the robot's torso in the plant.
        checks: The number of checks without progress after which a robot is stuck; 0: it never is.
        progress: The state: the largest distance from the axis (m), and the checks since it was reached.
    """

    def __init__(self, base: BodyIndex, *, period: float, patience: float = 0.0) -> None:
        """Declare the system.

        Args:
            base: Index of the robot's torso in the plant.
            period: Period of its checks, in s.
            patience: Time without progress (by `PROGRESS`, away from the axis) after which a robot is stuck, in s;
                0: it never is.
        """
        super().__init__()
        self.base = int(base)
        self.checks = patience / period
        self._poses = self.DeclareAbstractInputPort("body_poses", Value[list[RigidTransform]]())
        self.progress = self.declare_discrete_state(farthest=Quantity(0.0, "m"), checks_since=Quantity(0.0))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._check)

    def _check(self, context: Context, state: DiscreteValues) -> EventStatus:
        X_WB = self._poses.Eval(context)[self.base]
        distance = np.hypot(*X_WB.translation()[:2])
        if distance > RIM_RADIUS + PAST_RIM:
            return EventStatus.ReachedTermination(self, PASSED)
        rotation = X_WB.rotation().ToRollPitchYaw()
        if max(abs(rotation.roll_angle()), abs(rotation.pitch_angle())) > TIPPED_OVER:
            return EventStatus.ReachedTermination(self, TIPPED)
        progress = self.progress.mutable(state)
        if distance > progress.farthest + PROGRESS:
            progress.farthest, progress.checks_since = distance, 0.0
        else:
            progress.checks_since += 1.0
            if self.checks and progress.checks_since >= self.checks:
                return EventStatus.ReachedTermination(self, STUCK)
        return EventStatus.Succeeded()

    def compiled_equations(self, context: Context, varied: frozenset[str]) -> EndOfClimbEquations:
        """Return the equations for compiled testbeds.

        Args:
            context: The system's own context.
            varied: Names of its variables that will be varied.
        """
        return EndOfClimbEquations(self, context, varied)


class EndOfClimbEquations(Equations):
    """An `EndOfClimb`."""

    endings = ENDS

    def output(self, port: str, at: At) -> Expression:
        raise ValueError(f"EndOfClimb has no output port {port!r}")

    def update(self, at: At) -> dict[int, Expression]:
        return {int(self._climb.progress.index): self._check(at)[0]}

    def ending(self, at: At) -> Expression:
        return self._check(at)[1]

    @property
    def _climb(self) -> EndOfClimb:
        system: Any = self.system
        return system

    def _check(self, at: At) -> tuple[Expression, Expression]:
        """Return the next state, and the number of the ending."""
        R, p = at.input("body_poses")(self._climb.base)
        state = at.state(int(self._climb.progress.index))
        farthest, checks_since = state[0], state[1]
        distance = casadi.norm_2(p[:2])
        rpy = roll_pitch_yaw_angles(R)
        passed = distance > RIM_RADIUS + PAST_RIM
        tipped = casadi.fmax(casadi.fabs(rpy[0]), casadi.fabs(rpy[1])) > TIPPED_OVER
        advances = distance > farthest + PROGRESS
        count = casadi.if_else(advances, 0.0, checks_since + 1.0)
        stuck = casadi.logic_and(count > 0.0, count >= self._climb.checks) if self._climb.checks else casadi.SX(0)
        ending = casadi.if_else(passed, 1, casadi.if_else(tipped, 2, casadi.if_else(stuck, 3, 0)))
        following = casadi.vertcat(casadi.if_else(advances, distance, farthest), count)
        ends_early = casadi.logic_or(passed, tipped)
        return casadi.if_else(ends_early, state, following), ending
