"""A mass whose DPS decides on board where to push it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import inf

import numpy as np
from drake import lcmt_acrobot_u, lcmt_acrobot_x, lcmt_scope
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, DiscreteValues
from pydrake.systems.primitives import LinearSystem

from vtbdrake.control import Zero
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.maps import vector_map
from vtbdrake.lcm.protocol import Protocol
from vtbdrake.optimization import Parameter
from vtbdrake.reasoning import Budget, OnboardReasoner, SearchConfig
from vtbdrake.rollout import Constraint, Quality
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder

PERIOD = 0.01
PLANNER = "dps.planner"
CANDIDATE = f"{PLANNER}.candidate"
STATE = "sim.sys.mass.discrete_state_0"


class Law(AddressedSystem):
    """A spring and a damper to the set point; to the origin while there is no valid one.

    .. pydrake_system::

        name: Law
        input_ports:
        - state
        - setpoint
        - valid
        output_ports:
        - force
    """

    def __init__(self) -> None:
        super().__init__()
        self._command = self.declare_discrete_state(force=Quantity(unit="N"))
        self._state = self.DeclareVectorInputPort("state", BasicVector(2))
        self._setpoint = self.DeclareVectorInputPort("setpoint", BasicVector(1))
        self._valid = self.DeclareVectorInputPort("valid", BasicVector(1))
        self.DeclareStateOutputPort("force", self._command.index)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self._update)

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        x, v = self._state.Eval(context)
        (setpoint,), (valid,) = self._setpoint.Eval(context), self._valid.Eval(context)
        self._command.mutable(discrete).force = 9.0 * (valid * setpoint - x) - 1.5 * v


def missed_by(state: np.ndarray, goal: float) -> float:
    """Return the distance of the mass from the goal in the end."""
    return float(abs(state[0] - goal))


@dataclass
class PusherScenario(Scenario):
    """A mass of 1 kg on a rail. The set point that brings it closest to ``u.goal`` after a second is decided on board.

    The mass swings: the best set point is not the goal, and depends on the state at which the decision begins.
    """

    simulator_config: SimulatorConfig = field(default_factory=SimulatorConfig)
    latency: float = 0.2
    # The period of the receding horizon; 0 decides on request.
    every: float = 0.0
    rollouts: int = 12
    # Whether a loop waits for decisions, however long they take; else their time is limited by the latency.
    waits: bool = False
    horizon: float = 1.0
    method: str = "CEM"
    executor: str = "auto"
    # The largest position that a rollout may reach.
    wall: float = 1e3
    reasons: bool = True

    def mental(self) -> Scenario:
        return replace(self, reasons=False)

    def interface(self) -> Interface:
        request = [] if self.every else [Signal("request", size=1)]
        return Interface(
            sense=[Signal("state", size=2, unit="m, m/s", max_age=60.0)],
            act=[Signal("force", size=1, unit="N", lower=-50.0, upper=50.0, idle=0.0)],
            commands=[Signal("goal", size=1, unit="m"), *request],
        )

    def make_planner(self) -> OnboardReasoner:
        walls = [Constraint(lambda state: state[0], of=[STATE], at_most=self.wall)] if self.wall < 1e3 else []
        return OnboardReasoner(
            1,
            scenario=self,
            decision=[Parameter(CANDIDATE, -1.0, 1.0)],
            quality=Quality(missed_by, of=[STATE, "u.goal"], minimize=True, reading="end"),
            horizon=self.horizon,
            budget=Budget(rollouts=self.rollouts, seconds=60.0 if self.waits else None),
            period=self.every or PERIOD,
            latency=self.latency,
            patience=300.0 if self.waits else 3.0,
            on_request=not self.every,
            believed={"state": 2},
            mental=not self.reasons,
            options={
                "search": SearchConfig(method=self.method, executor=self.executor, workers=1),
                "constraints": walls,
            },
        )

    def make_dps(self) -> Diagram:
        builder = DiagramBuilder()
        planner = builder.AddNamedSystem("planner", self.make_planner())
        law = builder.AddNamedSystem("law", Law())
        builder.ExportInput(law.GetInputPort("state"), "state")
        builder.ConnectInput("state", planner.GetInputPort("state"))
        # The law has no use for the goal: the quality has.
        if not self.every:
            builder.ExportInput(planner.GetInputPort("request"), "request")
        builder.Connect(planner.GetOutputPort("decision"), law.GetInputPort("setpoint"))
        builder.Connect(planner.GetOutputPort("valid"), law.GetInputPort("valid"))
        goal = builder.AddNamedSystem("goal", LinearSystem([[0.0]], [[1.0]], [[1.0]], [[0.0]], PERIOD))
        builder.ExportInput(goal.get_input_port(), "goal")
        builder.ExportOutput(law.GetOutputPort("force"), "force")
        return builder.Build()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        h = PERIOD
        A, B = np.array([[1.0, h], [0.0, 1.0]]), np.array([[h * h / 2.0], [h]])
        mass = builder.add("sys", "mass", LinearSystem(A, B, np.eye(2), np.zeros((2, 1)), h))
        builder.sim_sensor("state", mass.get_output_port())
        builder.sim_actuator("force", mass.get_input_port())
        builder.believe(STATE, of=[f"{PLANNER}.state"])

    def deployment(self) -> Deployment:
        commands = [vector_map(name.upper(), lcmt_scope, {name: "value"}) for name in ("goal", "request")]
        return Deployment(
            protocol=Protocol(
                sense=[vector_map("STATE", lcmt_acrobot_x, {"state": ("theta1", "theta1Dot")}, stamp="timestamp")],
                act=[vector_map("FORCE", lcmt_acrobot_u, {"force": "tau"}, stamp="timestamp")],
                commands=commands[: 1 if self.every else 2],
            ),
            guards={"max_missed": inf, "fallback": {"force": Zero()}},
            continuity={"force": None},
        )
