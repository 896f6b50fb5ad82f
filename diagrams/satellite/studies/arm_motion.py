"""The testbed of application R2: the servicer's arm follows a plan from rest to rest, and its base floats freely."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from operator import itemgetter
from typing import TYPE_CHECKING

import numpy as np
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.framework import Diagram, DiagramBuilder, System
from pydrake.systems.primitives import AffineSystem, MatrixGain, ZeroOrderHold

from vtbdrake.common.arrays import Array
from vtbdrake.common.spline import Spline
from vtbdrake.components.compiled_plant import momentum_world, rotation_angle
from vtbdrake.components.sensors import ErrorModel, JointEncoders
from vtbdrake.components.spline_command import SplineCommand
from vtbdrake.optimization.parameter import Parameter
from vtbdrake.rollout import Constraint, Quality
from vtbdrake.testbed import Interface, Scenario, ScenarioError, Signal, VirtualTestbedBuilder
from vtbdrake_diagrams.satellite.arm_move import ORDER, REACHING, RESTING, Move, move_space
from vtbdrake_diagrams.satellite.bodies import ARM_JOINT_NAMES, ARM_JOINTS, JOINT_NAMES, Servicer
from vtbdrake_diagrams.satellite.plant import plant_config

if TYPE_CHECKING:
    from vtbdrake.reasoning import OnboardReasoner


PERIOD = 0.02
"""The sample period of sensors and DPS in s."""
BASE = "sim.sys.servicer.base.position"
"""The address of the base's pose: quaternion [w, x, y, z] of R_WB, then p_WoBo_W in m, shape (7,)."""
PLAN = "u.plan"
"""The address of the commanded plan [t_begin, knots in rad]."""
CANDIDATE = "dps.planner.candidate"
"""The address of the plan that the DPS decides itself, likewise [t_begin, knots in rad]."""

SAMPLE_PERIOD = 0.1
"""The sample period of the quality in s."""
SETTLING = 1.0
"""The time after a move in which the servos settle, in s."""

# When the DPS begins to decide, in s.
_FIRST = 5 * PERIOD
# How much larger than in the momentum model the deviation on the way may be: the servos lag behind, and settle.
_SLACK = 1.01


@dataclass
class ArmMotionScenario(Scenario):
    """The servicer's arm moves from a start to a goal, both at rest, along a plan; wheels and thrusters are off.

    The plan is the command ``u.plan``; or, with ``onboard``, the decision of a reasoner that is a part of the DPS,
    ``dps.planner``. Until something else is decided, the plan is the straight path in joint space, which begins after
    ``thinking_time``; if that exceeds a limit, the arm stays. The world is the capture's, without the target. A
    mental copy has no forces: there, the base moves as momentum demands.
    """

    plant_config: MultibodyPlantConfig = field(default_factory=plant_config)
    # Joint positions in rad, one per joint of the arm.
    start: list[float] = field(default_factory=lambda: list(Servicer().stowed))
    goal: list[float] = field(default_factory=lambda: list(REACHING))
    # Duration of the move, in seconds; and the knots of its plan.
    duration: float = 20.0
    knots: int = 9
    # Whether the DPS decides the plan itself; and in a mental copy of it, where it does not reason again.
    onboard: bool = False
    is_mental: bool = False
    # The time before the arm moves, in seconds, in which the DPS decides; and the budget of that.
    thinking_time: float = 10.0
    rollouts: int = 5
    # Errors of the encoders, exact by default; latency in periods.
    joint_errors: ErrorModel = field(default_factory=ErrorModel)

    def validate(self) -> None:
        super().validate()
        servicer = Servicer()
        for name in ("start", "goal"):
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape != (ARM_JOINTS,) or not ((servicer.lower <= value) & (value <= servicer.upper)).all():
                raise ScenarioError(
                    f"ArmMotionScenario.{name} must be {ARM_JOINTS} positions within the joints' limits, not "
                    f"{getattr(self, name)!r}"
                )
        if not self.thinking_time > _FIRST:
            raise ScenarioError(
                f"ArmMotionScenario.thinking_time must be more than {_FIRST:g} s, not {self.thinking_time!r}"
            )
        try:
            self.move()
        except ValueError as error:
            raise ScenarioError(str(error)) from None

    def move(self) -> Move:
        """Return the move, with its momentum model, which is compiled for the first move of that duration."""
        return Move(move_space(self.duration, self.knots), np.array(self.start), np.array(self.goal))

    @property
    def horizon(self) -> float:
        """Return the time at which the servos have settled, in seconds."""
        return self.thinking_time + self.duration + SETTLING

    def plan(self, knots: Array) -> Array:
        """Return the plan of some knots, shape (n, 7): it begins after the thinking time."""
        return np.concatenate([[self.thinking_time], np.ravel(knots)])

    def initial_plan(self) -> Array:
        """Return the plan until another is decided: the straight path; or, if that exceeds a limit, to stay."""
        move = self.move()
        return self.plan(np.tile(move.start, (self.knots, 1)) if move.excess(move.straight) else move.straight)

    def mental(self) -> ArmMotionScenario:
        """Return the scenario of the mental copy: no forces, encoders without random errors."""
        errors = replace(self.joint_errors, noise=0.0, drift=0.0, dropout=0.0)
        return replace(self, is_mental=True, joint_errors=errors)

    def interface(self) -> Interface:
        s, age = Servicer(), 5 * PERIOD
        fingers = np.full(2, s.opening)
        lower, upper = np.concatenate((s.lower, 0.0 * fingers)), np.concatenate((s.upper, fingers))
        rate = np.concatenate((s.speeds, np.full(2, s.finger_speed)))
        idle = np.concatenate((self.start, fingers))
        size = 1 + self.knots * ARM_JOINTS
        # A plan begins at a time of the DPS, which runs for thirty years at most; its knots are turns of joints.
        limit = np.append(1e9, np.full(size - 1, 2.0 * np.pi))
        plan = Signal("plan", size=size, unit="s, rad, ...", lower=-limit, upper=limit, default=self.initial_plan())
        return Interface(
            sense=[
                Signal(
                    "joint_position", size=ARM_JOINTS, unit="rad", lower=s.lower - 0.1, upper=s.upper + 0.1, max_age=age
                )
            ],
            act=[Signal("joint_position", size=9, unit="rad, m", lower=lower, upper=upper, rate=rate, idle=idle)],
            commands=[] if self.onboard else [plan],
        )

    def make_dps(self) -> Diagram:
        return make_dps(self, self._make_planner() if self.onboard else None)

    def _make_planner(self) -> OnboardReasoner:
        # Imported here: without it, the DPS needs no optimization.
        from vtbdrake.reasoning import Budget, OnboardReasoner, SearchConfig
        from vtbdrake_diagrams.satellite.arm_planning import MomentumDescent

        return OnboardReasoner(
            1 + self.knots * ARM_JOINTS,
            scenario=self,
            # It decides once, as soon as the sensors have shown where the arm is.
            offset=_FIRST,
            period=2.0 * self.horizon,
            latency=self.thinking_time - _FIRST,
            initial=self.initial_plan(),
            budget=Budget(rollouts=self.rollouts),
            mental=self.is_mental,
            decision=free_knots(self, CANDIDATE),
            quality=DEVIATION,
            horizon=self.horizon,
            options={
                "constraints": limits(self, CANDIDATE),
                "sample_period": SAMPLE_PERIOD,
                "search": SearchConfig(
                    method=MomentumDescent,
                    options={"origin": self.start, "goal": self.goal, "duration": self.duration, "knots": self.knots},
                ),
            },
        )

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        if self.is_mental:
            self._add_mental_world(builder)
        else:
            self._add_plant(builder)
        positions = [f"sim.sys.servicer.{name}.position" for name in ARM_JOINT_NAMES]
        age = (1 + self.joint_errors.latency) * PERIOD
        builder.believe(positions, of=["dps.env.discrete_state_0"], by=itemgetter(slice(len(positions))), age=age)

    def _add_plant(self, builder: VirtualTestbedBuilder) -> None:
        from vtbdrake_diagrams.satellite.plant import add_servicer

        plant, _ = builder.add_plant(self.plant_config)
        servicer = add_servicer(plant, replace(Servicer(), stowed=tuple(self.start)))
        plant.Finalize()
        arm = [plant.GetJointByName(name, servicer) for name in ARM_JOINT_NAMES]
        builder.add_sensor("joint_position", JointEncoders(plant, arm, period=PERIOD, errors=self.joint_errors))
        # The servos are the plant's own PD controllers; they are to reach the position and to rest there.
        n = len(JOINT_NAMES)
        servos = builder.add("act", "servos", MatrixGain(np.vstack([np.eye(n), np.zeros((n, n))])))
        builder.connect(servos.get_output_port(), plant.get_desired_state_input_port(servicer))
        builder.sim_actuator("joint_position", servos.get_input_port())

    def _add_mental_world(self, builder: VirtualTestbedBuilder) -> None:
        world = builder.add("sys", "servicer", momentum_world(self.move().space.model, self.start, period=PERIOD))
        joints = np.eye(ARM_JOINTS, len(JOINT_NAMES))
        servos = builder.add("act", "servos", MatrixGain(joints))
        builder.connect(servos.get_output_port(), world.GetInputPort("position"))
        builder.sim_actuator("joint_position", servos.get_input_port())
        encoders = builder.add("sense", "joint_position", MatrixGain(np.eye(ARM_JOINTS, 7 + ARM_JOINTS, 7)))
        builder.connect(world.GetOutputPort("state"), encoders.get_input_port())
        builder.sim_sensor("joint_position", encoders.get_output_port())


def make_dps(scenario: ArmMotionScenario, planner: System | None = None) -> Diagram:
    """Return the DPS: ``env`` perceives, ``impl`` follows the plan, ``act`` adds the fingers, which stay open.

    Input ports: ``joint_position`` (7, rad) and, without a planner, the command ``plan``, see `SplineCommand`. Output
    port: ``joint_position`` (9, rad and m).

    Args:
        scenario: Names the curve and the start.
        planner: The system that decides the plan, with the output port ``decision``; None: the plan is a command.
    """
    builder = DiagramBuilder()
    env = builder.AddNamedSystem("env", ZeroOrderHold(PERIOD, ARM_JOINTS))
    spline = Spline(ORDER, scenario.knots, scenario.duration)
    command = SplineCommand(spline, period=PERIOD, size=ARM_JOINTS, initial=scenario.start, unit="rad")
    impl = builder.AddNamedSystem("impl", command)
    n, fingers = len(JOINT_NAMES), np.zeros(len(JOINT_NAMES))
    fingers[ARM_JOINTS:] = Servicer().opening
    empty = np.zeros((0, 0))
    act = AffineSystem(empty, np.zeros((0, ARM_JOINTS)), np.zeros(0), np.zeros((n, 0)), np.eye(n, ARM_JOINTS), fingers)
    builder.AddNamedSystem("act", act)
    builder.ExportInput(env.get_input_port(), "joint_position")
    if planner is None:
        builder.ExportInput(impl.GetInputPort("plan"), "plan")
    else:
        builder.AddNamedSystem("planner", planner)
        builder.Connect(planner.GetOutputPort("decision"), impl.GetInputPort("plan"))
    builder.Connect(impl.GetOutputPort("value"), act.get_input_port())
    builder.ExportOutput(act.get_output_port(), "joint_position")
    dps = builder.Build()
    dps.set_name("dps")
    return dps


def deviation(X_WB: Array) -> float:
    """Return the base attitude deviation in rad, for the pose [quaternion; position] of a base that was at zero."""
    return float(rotation_angle(X_WB[:4]))


DEVIATION = Quality(deviation, of=BASE, reading="end", minimize=True)
"""The quality q of application R2: the base attitude deviation at the end, in rad."""


def free_knots(scenario: ArmMotionScenario, address: str) -> list[Parameter]:
    """Return the decision variables: the free knots of the plan at ``address``, with their ranges."""
    move = scenario.move()
    ends = move.search_range
    first = 1 + ARM_JOINTS * RESTING
    return [Parameter(f"{address}[{first + k}]", *pair) for k, pair in enumerate(zip(*ends, strict=True))]


def limits(scenario: ArmMotionScenario, address: str) -> list[Constraint]:
    """Return the constraints of a rollout with the plan at ``address``, on the deviation on the way and on the plan."""
    largest = scenario.move().largest
    excess = partial(_excess, tuple(scenario.start), tuple(scenario.goal), scenario.duration, scenario.knots)
    return [
        Constraint(deviation, of=BASE, at_most=_SLACK * largest),
        Constraint(excess, of=address, at_most=0.0),
    ]


def _excess(start: tuple[float, ...], goal: tuple[float, ...], duration: float, knots: int, plan: Array) -> float:
    """Return by how much a plan exceeds its worst limit, the deviation aside."""
    return _worst(start, goal, duration, knots, np.asarray(plan[1:], dtype=float).tobytes())


@lru_cache(maxsize=8)  # A plan is the same at every sample of a rollout.
def _worst(start: tuple[float, ...], goal: tuple[float, ...], duration: float, knots: int, plan: bytes) -> float:
    move = Move(move_space(duration, knots), np.array(start), np.array(goal))
    excess = move.excess(np.frombuffer(plan).reshape(knots, ARM_JOINTS))
    return max((value for name, value in excess.items() if name != "deviation"), default=0.0)
