"""The cart-pole testbed: a cart that is pushed along a rail, and a pole that hangs from it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from drake import lcmt_acrobot_u, lcmt_acrobot_x, lcmt_scope
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.framework import Diagram
from pydrake.systems.primitives import Demultiplexer, ZeroOrderHold

from vtbdrake.common.settings import setting
from vtbdrake.common.spline import Spline
from vtbdrake.components.sensors import ErrorModel, JointEncoders, JointTachometers
from vtbdrake.control import RobotMode, Zero, acts_idle
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.maps import vector_map
from vtbdrake.lcm.protocol import Protocol
from vtbdrake.testbed import Interface, Scenario, ScenarioError, Signal, VirtualTestbedBuilder
from vtbdrake_diagrams.cart_pole.dps import FORCE, JOINTS, PERCEIVED, make_dps
from vtbdrake_diagrams.cart_pole.model import CART_POLE_SDF, JOINT_NAMES, CartPole

if TYPE_CHECKING:
    from vtbdrake.reasoning import OnboardReasoner

# In lock-step, the longest wall time of a decision, in seconds.
_PATIENCE = 10.0


def _plant(time_step: float) -> MultibodyPlantConfig:
    # Unsampled: else, a step of the plant comes before the sensors of the same instant.
    return MultibodyPlantConfig(time_step=time_step, use_sampled_output_ports=False)


@dataclass
class CartPoleScenario(Scenario):
    """Drake's cart-pole under a plan of forces [t_begin, knots in N], which is to be decided.

    The plan is the command ``u.plan``; or, with ``onboard``, the decision of a reasoner that is a part of the DPS,
    ``dps.planner``. The pole hangs at the angle 0 and stands at pi. A mental copy simulates the same cart-pole with a
    time step that is as long as the sample period.
    """

    plant_config: MultibodyPlantConfig = field(default_factory=lambda: _plant(0.005))
    period: float = setting(0.02, "The sample period of sensors and DPS.", unit="s", gt=0.0)
    force_limit: float = setting(
        60.0, "The largest force on the cart: too little to swing up the pole in one go.", unit="N", gt=0.0
    )
    # The plan: its curve (see Spline), its knots, and its duration in seconds.
    order: str = "linear"
    knots: int = 10
    duration: float = 1.0
    # Whether the DPS decides the plan itself; and in a mental copy of it, where it does not reason again.
    onboard: bool = False
    is_mental: bool = False
    # The time from one decision to the next, and the time that one takes, in seconds; and its budget. By the clock,
    # two periods of it go to the way there and back: give 0.1 s or more there.
    thinking_period: float = 0.06
    thinking_time: float = 0.06
    rollouts: int = 20
    # Whether the machine waits, so that a decision on board may take longer than thinking_time by the wall clock.
    lock_step: bool = False
    # Errors of the sensors, exact by default; latency in periods.
    position_errors: ErrorModel = field(default_factory=ErrorModel)
    velocity_errors: ErrorModel = field(default_factory=ErrorModel)

    def validate(self) -> None:
        super().validate()
        try:
            self.plan()
        except ValueError as error:
            raise ScenarioError(str(error)) from None

    def plan(self) -> Spline:
        """Return the curve of a plan."""
        return Spline(self.order, self.knots, self.duration)

    def mental(self) -> CartPoleScenario:
        """Return the scenario of the mental copy: one time step per sample, sensors without random errors."""
        errors = {name: getattr(self, name).without_chance() for name in ("position_errors", "velocity_errors")}
        return replace(self, plant_config=_plant(self.period), is_mental=True, **errors)

    def interface(self) -> Interface:
        age = 5 * self.period
        return Interface(
            sense=[
                Signal(
                    "joint_position", size=JOINTS, unit="m, rad", lower=[-100.0, -1e3], upper=[100.0, 1e3], max_age=age
                ),
                Signal("joint_velocity", size=JOINTS, unit="m/s, rad/s", lower=-100.0, upper=100.0, max_age=age),
            ],
            act=[Signal("force", size=1, unit="N", lower=-self.force_limit, upper=self.force_limit, idle=0.0)],
            commands=self._commands(),
        )

    def _commands(self) -> list[Signal]:
        if self.onboard:
            return []
        # A plan begins at a time of the DPS, which runs for thirty years at most.
        limit = np.append(1e9, np.full(self.knots, self.force_limit))
        names = ["start", *(f"force {knot}" for knot in range(1, self.knots + 1))]
        return [Signal("plan", size=1 + self.knots, unit="s, N, ...", lower=-limit, upper=limit, entry_names=names)]

    def deployment(self) -> Deployment:
        """Return how the DPS runs on the cart-pole: it answers each state at once; after a fault there is no force.

        The cart-pole speaks the messages of Drake's acrobot, which has two joints and one drive, too. CART_POLE_ACTING
        tells the force that acts, and CART_POLE_MODE whether it takes commands (see `RobotMode`): its own stop blocks
        them. CART_POLE_PLAN carries the plan if it is a command.
        """
        joints = {"joint_position": ("theta1", "theta2"), "joint_velocity": ("theta1Dot", "theta2Dot")}
        deployment = Deployment(
            protocol=Protocol(
                sense=[
                    vector_map("CART_POLE_MODE", lcmt_scope, {"cart_pole_mode": "value"}),
                    vector_map("CART_POLE_ACTING", lcmt_acrobot_u, {"force_acting": "tau"}, stamp="timestamp"),
                    vector_map("CART_POLE_STATE", lcmt_acrobot_x, joints, stamp="timestamp"),
                ],
                act=[vector_map("CART_POLE_FORCE", lcmt_acrobot_u, {"force": "tau"}, stamp="timestamp")],
                commands=[vector_map("CART_POLE_PLAN", lcmt_scope, {u.name: "value"}) for u in self._commands()],
                reported={"force": "force_acting"},
                robot_mode=RobotMode(carrier="cart_pole_mode"),
            ),
            period=self.period,
            guards={"fallback": {"force": Zero()}},
            released_by=acts_idle({"force": 0.0}),
            continuity={"force": None},  # Nothing measures the force, which may jump.
            pace="joint_velocity",
        )
        return deployment.in_lock_step("joint_velocity") if self.lock_step else deployment

    def make_dps(self) -> Diagram:
        planner = self._make_planner() if self.onboard else None
        return make_dps(self.plan(), period=self.period, force_limit=self.force_limit, planner=planner)

    def _make_planner(self) -> OnboardReasoner:
        # Imported here: without it, the DPS needs no optimization.
        from vtbdrake.reasoning import Budget, OnboardReasoner
        from vtbdrake_diagrams.cart_pole.decision import reasoning

        # A loop with this period takes a result that is there two cycles before it is due.
        seconds = 0.8 * max(self.thinking_time - 2.0 * self.period, 0.1 * self.thinking_time)
        budget = Budget(rollouts=self.rollouts, seconds=_PATIENCE if self.lock_step else seconds)
        arguments = reasoning(self, "dps.planner.candidate", budget)
        named = {name: arguments.pop(name) for name in ("decision", "quality", "horizon", "budget")}
        return OnboardReasoner(
            1 + self.knots,
            scenario=self,
            period=self.thinking_period,
            latency=self.thinking_time,
            # Late is better than a new worker, whose start takes some seconds.
            patience=2.0 * _PATIENCE / self.thinking_time,
            mental=self.is_mental,
            options=arguments,
            **named,
        )

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        # Imported here: the DPS on the machine runs without a plant.
        from pydrake.multibody.parsing import Parser

        plant, _ = builder.add_plant(self.plant_config)
        (instance,) = Parser(plant).AddModels(str(CART_POLE_SDF))
        plant.Finalize()
        joints = [plant.GetJointByName(name, instance) for name in JOINT_NAMES]
        T = self.period
        if self.is_mental and self._has_exact_sensors:
            # Drake's own systems sample in the same way: with ours, in Python, a rollout takes a third longer.
            state = builder.add("sense", "state", Demultiplexer(2 * JOINTS, JOINTS))
            builder.connect(plant.get_state_output_port(), state.get_input_port())
            for index, signal in enumerate(("joint_position", "joint_velocity")):
                sampled = builder.add("sense", signal, ZeroOrderHold(T, JOINTS))
                builder.connect(state.get_output_port(index), sampled.get_input_port())
                builder.sim_sensor(signal, sampled.get_output_port())
        else:
            builder.add_sensor("joint_position", JointEncoders(plant, joints, period=T, errors=self.position_errors))
            builder.add_sensor("joint_velocity", JointTachometers(plant, joints, period=T, errors=self.velocity_errors))
        builder.sim_actuator("force", plant.get_actuation_input_port(instance))
        self.add_beliefs(builder)

    @property
    def _has_exact_sensors(self) -> bool:
        return all(replace(errors, seed=0) == ErrorModel() for errors in (self.position_errors, self.velocity_errors))

    @property
    def force_address(self) -> str:
        """Return the address of the force that the DPS commands, in N."""
        return FORCE

    def add_beliefs(self, builder: VirtualTestbedBuilder) -> None:
        """Declare that the perceived state sets the joints of the simulated world.

        It was measured up to two periods before: sensors and ``env`` take one each. The present state follows from it
        and from the force that acts.
        """
        T, model = self.period, CartPole()
        for i, (value, errors) in enumerate((("position", self.position_errors), ("velocity", self.velocity_errors))):
            builder.believe(
                [f"sim.sys.cart_pole.{name}.{value}" for name in JOINT_NAMES],
                of=[PERCEIVED, self.force_address],
                by=partial(_present, model, entries=slice(JOINTS * i, JOINTS * (i + 1))),
                age=(1 + errors.latency) * T,
                period=T,
            )


def _present(model: CartPole, state: np.ndarray, force: float, *, entries: slice, late: float) -> np.ndarray:
    return model.advanced(state, float(force), late)[entries]
