"""The arm that follows a plan in joint space, as a calibration needs it: the motion is a command, not a routine."""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi
import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder

from vtbdrake.common.settings import setting
from vtbdrake.common.spline import Spline
from vtbdrake.components.casadi_system import CasadiSystem, clamp
from vtbdrake.components.spline_command import SplineCommand
from vtbdrake.deployment import Deployment
from vtbdrake.testbed import Interface, Signal
from vtbdrake_diagrams.manipulator.arm import JOINTS, Arm
from vtbdrake_diagrams.manipulator.dps import SENSOR_SIGNALS, gravity_torque
from vtbdrake_diagrams.manipulator.dynamics import ArmDynamics, function
from vtbdrake_diagrams.manipulator.laws import LAWS
from vtbdrake_diagrams.manipulator.scenario import ManipulatorScenario

PLAN = "u.plan"
"""The address of the plan [t_begin, knots in rad], see `SplineCommand`."""


_MEASURED = ("joint_position", "joint_velocity")
_VELOCITY_TIME_CONSTANT = 0.002  # s, of the velocity that is estimated from the positions


@dataclass
class ExcitedArmScenario(ManipulatorScenario):
    """The arm follows the plan ``u.plan`` by the joint impedance law; guards, machine and messages are the arm's own.

    Until a plan is given, the arm stays at home.
    """

    law: str = setting("joint_impedance", "The control law.", choices=("joint_impedance",))
    knots: int = setting(16, "The number of knots of a plan, a cubic B-spline.", ge=4)
    duration: float = setting(10.0, "The duration of a plan, which is repeated.", unit="s", gt=0.0)

    @property
    def spline(self) -> Spline:
        """Return the curve of a plan."""
        return Spline("bspline", self.knots, self.duration)

    def interface(self) -> Interface:
        arm, base = Arm(), super().interface()
        # A plan begins at a time of the DPS, which runs for thirty years at most.
        lower, upper = (np.tile(limit, self.knots) for limit in (arm.lower, arm.upper))
        plan = Signal(
            "plan",
            size=1 + lower.size,
            unit="s, rad, ...",
            lower=np.append(-1e9, lower),
            upper=np.append(1e9, upper),
            default=np.append(0.0, np.tile(arm.home, self.knots)),
        )
        return Interface(sense=base.sense, act=base.act, commands=[plan])

    def deployment(self) -> Deployment:
        """Return how the DPS runs on the arm: as the other DPS of the arm; the plan is written, not sent."""
        deployment = super().deployment()
        assert deployment.protocol is not None
        return replace(deployment, protocol=replace(deployment.protocol, commands=[]), hint="")

    def make_dps(self) -> Diagram:
        return make_dps(self.spline, period=self.period, compile=self.compile)


def make_dps(spline: Spline, *, period: float = 0.001, compile: bool = True) -> Diagram:
    """Return the DPS: ``env`` perceives, ``reference`` follows the plan, ``impl`` controls.

    Ports are as in `vtbdrake_diagrams.manipulator.dps.make_dps`, with the command ``plan`` in place of ``motion``.

    Args:
        spline: The curve of a plan.
        period: The sample period, in seconds.
        compile: Compile the arithmetic if there is a C compiler.
    """
    arm, builder = Arm(), DiagramBuilder()
    env = builder.AddNamedSystem("env", _make_env(arm, period))
    command = SplineCommand(spline, period=period, size=JOINTS, initial=arm.home, unit="rad", repeat=True)
    reference = builder.AddNamedSystem("reference", command)
    impl = builder.AddNamedSystem("impl", _make_impl(ArmDynamics(arm), period, None if compile else False))
    for signal in SENSOR_SIGNALS:
        index = builder.ExportInput(env.GetInputPort(f"measured_{signal}"), signal)
        if signal == "joint_position":
            builder.ConnectInput(index, impl.GetInputPort(signal))
    builder.ExportInput(reference.GetInputPort("plan"), "plan")
    builder.Connect(reference.GetOutputPort("value"), impl.GetInputPort("reference"))
    builder.ExportOutput(impl.GetOutputPort("torque"), "joint_torque")
    dps = builder.Build()
    dps.set_name("dps")
    return dps


def _make_env(arm: Arm, period: float) -> CasadiSystem:
    signals = {signal: casadi.SX.sym(signal, size) for signal, size in SENSOR_SIGNALS.items()}
    inputs = {f"measured_{signal}": symbol for signal, symbol in signals.items()}
    states = {signal: casadi.SX.sym("x", JOINTS) for signal in _MEASURED}
    following = {f"{signal}_next": signals[signal] for signal in states}
    initial = {"joint_position": arm.home, "joint_velocity": np.zeros(JOINTS)}
    return CasadiSystem(update=function("env", {**states, **inputs}, following), state=initial, period=period)


def _make_impl(model: ArmDynamics, period: float, compile: bool | None) -> CasadiSystem:
    """Return the joint impedance law of `laws`; the reference's derivatives are differences over one period.

    The velocity is estimated from the positions, by differences through a first-order low-pass: the torque depends on
    nothing that a recording of positions and torques lacks. A controller that saw disturbances earlier, by a
    tachometer, would make a calibration with the positions wrong: most of all the delay.
    """
    sizes = {"torque": JOINTS, "q_r": JOINTS, "v_r": JOINTS, "q": JOINTS, "v": JOINTS}
    state = {name: casadi.SX.sym(name, size) for name, size in sizes.items()}
    gains = LAWS["joint_impedance"].parameters
    K, D = (casadi.SX.sym(name, JOINTS) for name in ("stiffness", "damping"))
    rate = casadi.SX.sym("velocity_time_constant")
    q, q_r = casadi.SX.sym("joint_position", JOINTS), casadi.SX.sym("reference", JOINTS)
    v = state["v"] + (1 - casadi.exp(-period / rate)) * ((q - state["q"]) / period - state["v"])
    v_r = (q_r - state["q_r"]) / period
    a_r = (v_r - state["v_r"]) / period
    tau = K * (q_r - q) + D * (v_r - v) + model.inverse_dynamics(q, v, a_r)
    reach, limits = period * np.array(model.arm.torque_rates), np.array(model.arm.torques)
    tau = clamp(clamp(tau, -limits, limits), state["torque"] - reach, state["torque"] + reach)
    following = {"torque_next": tau, "q_r_next": q_r, "v_r_next": v_r, "q_next": q, "v_next": v}
    arguments = {"stiffness": K, "damping": D, "velocity_time_constant": rate, "joint_position": q, "reference": q_r}
    zero = np.zeros(JOINTS)
    return CasadiSystem(
        update=function("impl", {**state, **arguments}, following),
        state={"torque": gravity_torque(model), "q_r": model.arm.home, "v_r": zero, "q": model.arm.home, "v": zero},
        parameters={
            "stiffness": gains["stiffness"][0],
            "damping": gains["damping"][0],
            "velocity_time_constant": _VELOCITY_TIME_CONSTANT,
        },
        units={
            "torque": "N m",
            "q_r": "rad",
            "v_r": "rad/s",
            "q": "rad",
            "v": "rad/s",
            "stiffness": gains["stiffness"][1],
            "damping": gains["damping"][1],
            "velocity_time_constant": "s",
        },
        bounds={"velocity_time_constant": (1e-4, 0.1)},
        period=period,
        compile=compile,
    )
