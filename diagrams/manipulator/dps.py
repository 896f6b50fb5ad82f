"""The data processing system of the arm: one function builds it for the testbed, its copies and the robot."""

from __future__ import annotations

from collections.abc import Mapping

import casadi
import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder, System
from pydrake.systems.primitives import Adder, ConstantVectorSource, Demultiplexer, Multiplexer, Saturation

from vtbdrake.components.casadi_system import CasadiSystem, clamp
from vtbdrake.state import NamedVector, Quantity
from vtbdrake.state.declarations import DISCRETE, PARAMETER, Element
from vtbdrake.testbed.hand_command import HAND_SIZE
from vtbdrake_diagrams.manipulator import leading
from vtbdrake_diagrams.manipulator.arm import GRAVITY, JOINTS, Arm
from vtbdrake_diagrams.manipulator.dynamics import ArmDynamics, Expression, function
from vtbdrake_diagrams.manipulator.laws import LAWS, Declared, Instant
from vtbdrake_diagrams.manipulator.motions import Motion, parameters, reference

# Name -> (initial value, unit). Other systems need the first one.
States = dict[str, tuple[object, str]]

_STATE = "state"

SENSOR_SIGNALS = {"joint_position": JOINTS, "joint_velocity": JOINTS, "joint_torque_measured": JOINTS, "wrench": 6}

# What sensors and drives that work can be off by, in rad, rad/s, N m, and N m and N.
LARGEST_OFFSETS = {"joint_position": 0.1, "joint_velocity": 0.5, "joint_torque_measured": 20.0, "wrench": 100.0}
LARGEST_TOOL = 15.0
"""The largest mass of a tool that the DPS can be told, in kg."""


def make_dps(
    law: str = "cartesian_impedance",
    *,
    period: float = 0.001,
    arm: Arm | None = None,
    compile: bool = True,
    knows_tool: bool = False,
    led_by_hand: bool = False,
) -> Diagram:
    """Return the DPS: ``sense`` calibrates, ``env`` perceives, ``impl`` controls, ``act`` limits.

    Input ports: ``joint_position`` (7, rad), ``joint_velocity`` (7, rad/s), ``joint_torque_measured`` (7, N m, on the
    joints' output side), ``wrench`` (6, [torque; force] that the tool exerts on the sensor at the flange, in the
    sensor's frame) and the command ``motion``, see `motions`. Output port: ``joint_torque`` (7, N m).

    ``env`` and ``impl`` are sampled with ``period`` (s) and show their own state: no input feeds through. What is at
    the input at one sample is in the torque from then on. The wrench is perceived first, and acts one period later.

    Args:
        law: The control law, a key of `LAWS`.
        period: The sample period of ``env`` and ``impl``, in seconds.
        arm: The arm that the controller assumes.
        compile: Compile the arithmetic if there is a C compiler, which is needed at the first use only; the results are
            the same, bit for bit.
        knows_tool: Add ``tool``, whose parameters ``mass`` (kg) and ``center`` (3, m) are what the DPS knows about the
            tool. Mental rollouts and predictions use them; the control law and ``env`` do not.
        led_by_hand: Add the command ``hand`` and the motion `led`, see `leading`.

    Raises:
        ValueError: There is no such law.
    """
    if law not in LAWS:
        raise ValueError(f"law is {law!r}, but must be one of {', '.join(LAWS)}.")
    model = ArmDynamics(arm)
    builder = DiagramBuilder()
    sense = builder.AddNamedSystem("sense", _make_sense())
    env = builder.AddNamedSystem("env", _make_env(model, period=period, compile=compile))
    perceived = env.GetOutputPort(_STATE)
    impl = builder.AddNamedSystem(
        "impl", _make_impl(model, law, perceived.size(), period=period, compile=compile, led_by_hand=led_by_hand)
    )
    act = builder.AddNamedSystem("act", _make_act(model.arm, impl.GetOutputPort(_STATE).size()))
    for signal in SENSOR_SIGNALS:
        builder.ExportInput(sense.GetInputPort(signal), signal)
    builder.ExportInput(impl.GetInputPort("wanted"), "motion")
    if led_by_hand:
        builder.ExportInput(impl.GetInputPort("hand"), "hand")
    builder.Connect(sense.get_output_port(), env.GetInputPort("measured"))
    builder.Connect(sense.get_output_port(), impl.GetInputPort("measured"))
    builder.Connect(perceived, impl.GetInputPort("perceived"))
    builder.Connect(impl.GetOutputPort(_STATE), act.GetInputPort("controlled"))
    builder.ExportOutput(act.get_output_port(), "joint_torque")
    if knows_tool:
        tool = NamedVector(
            mass=Quantity(model.arm.tool_mass, "kg"), center=Quantity(model.arm.tool_inertia().get_com(), "m")
        )
        source = builder.AddNamedSystem("tool", ConstantVectorSource(tool.array()))
        source.variables = tuple(tool.elements(PARAMETER, 0))
    dps = builder.Build()
    dps.set_name("dps")
    return dps


def _make_sense() -> Diagram:
    """Return the system that adds the parameter ``offset`` to the raw values."""
    builder = DiagramBuilder()
    raw = builder.AddNamedSystem("raw", Multiplexer(list(SENSOR_SIGNALS.values())))
    size = sum(SENSOR_SIGNALS.values())
    offset = builder.AddNamedSystem("offset", ConstantVectorSource(np.zeros(size)))
    largest = np.concatenate([np.full(SENSOR_SIGNALS[signal], most) for signal, most in LARGEST_OFFSETS.items()])
    offset.variables = (Element("value", PARAMETER, 0, (size,), bounds=(-largest, largest)),)
    measured = builder.AddNamedSystem("measured", Adder(2, size))
    for k, signal in enumerate(SENSOR_SIGNALS):
        builder.ExportInput(raw.get_input_port(k), signal)
    builder.Connect(raw.get_output_port(), measured.get_input_port(0))
    builder.Connect(offset.get_output_port(), measured.get_input_port(1))
    builder.ExportOutput(measured.get_output_port(), "measured")
    return builder.Build()


def _make_env(model: ArmDynamics, *, period: float, compile: bool) -> System:
    r"""Return the system that perceives the environment: where the arm is, and what touches it.

    ``contact_wrench`` F_T, [torque; force] that the environment exerts on the tip, in the world, follows the sensor's
    wrench, less the tool's weight, by a first-order low-pass. (The tool's inertia is left in: 0.4 N at 1 m/s^2.)

    ``external_torque`` r, of the environment on the joints, comes from a momentum observer,

        r = k (p - s),   s' = tau + dL/dq + r,

    with the links' momentum p = M v and the measured torques tau: r follows J' F by a low-pass of the rate k (De Luca,
    Mattone, "Sensorless Robot Collision Detection and Hybrid Force/Motion Control", 2005). A robot that starts in
    motion starts with a wrong r, which dies out at the same rate.
    """
    z = casadi.SX.sym("measured", sum(SENSOR_SIGNALS.values()))
    q, v, tau, wrench_S = casadi.vertsplit(z, [0, *np.cumsum(list(SENSOR_SIGNALS.values())).tolist()])
    gains: Declared = {
        "tool_mass": (model.arm.tool_mass, "kg", (0.0, LARGEST_TOOL)),
        "tool_center": (model.arm.tool_inertia().get_com(), "m", (-1.0, 1.0)),
        "wrench_time_constant": (0.002, "s", (0.0, 1.0)),
        "observer_rate": (100.0, "1/s", (0.0, 1.0 / period)),
    }
    p = _symbols(gains)
    state: States = {
        "contact_wrench": (np.zeros(6), "N m, N"),
        "joint_position": (model.arm.home, "rad"),
        "joint_velocity": (np.zeros(JOINTS), "rad/s"),
        "external_torque": (np.zeros(JOINTS), "N m"),
        "momentum_integral": (np.zeros(JOINTS), "N m s"),
    }
    x = _symbols(state)

    tip = model.tip(q)
    weight = casadi.vertcat(0, 0, -p["tool_mass"] * GRAVITY)
    force = tip.R @ wrench_S[3:] - weight
    # About the sensor's origin, then about the tip.
    torque = tip.R @ wrench_S[:3] - casadi.cross(tip.R @ p["tool_center"], weight)
    torque -= casadi.cross(model.arm.tool_length * tip.R[:, 2], force)
    gain = 1 - casadi.exp(-period / casadi.fmax(p["wrench_time_constant"], 1e-9))
    felt = x["contact_wrench"] + gain * (casadi.vertcat(torque, force) - x["contact_wrench"])

    momentum, dL_dq = model.momentum(q, v)
    external = p["observer_rate"] * (momentum - x["momentum_integral"])
    following = {
        "contact_wrench": felt,
        "joint_position": q,
        "joint_velocity": v,
        "external_torque": external,
        "momentum_integral": x["momentum_integral"] + period * (tau + dL_dq + external),
    }
    return _system(
        "env",
        following,
        state=state,
        x=x,
        gains=gains,
        p=p,
        inputs={"measured": z},
        period=period,
        compile=compile,
    )


def _make_impl(
    model: ArmDynamics, law: str, perceived: int, *, period: float, compile: bool, led_by_hand: bool
) -> System:
    """Return the system of motions and control law; ``torque`` changes no faster than ``torque_rate``.

    ``perceived`` is the size of the state of ``env``.
    """
    control_law = LAWS[law]
    z = casadi.SX.sym("measured", sum(SENSOR_SIGNALS.values()))
    q, v = z[:JOINTS], z[JOINTS : 2 * JOINTS]
    command, environment = casadi.SX.sym("wanted"), casadi.SX.sym("perceived", perceived)
    wrench = environment[:6]
    gains: Declared = {
        **control_law.parameters,
        **parameters(model.arm),
        # At most from one end of the range to the other within a period.
        "torque_rate": (model.arm.torque_rates, "N m/s", (0.0, 2.0 * np.array(model.arm.torques) / period)),
        **(leading.GAINS if led_by_hand else {}),
    }
    p = _symbols(gains)
    state: States = {
        "torque": (gravity_torque(model), "N m"),
        "motion": (Motion.HOME, "1"),
        "clock": (0.0, "s"),
        "start": (model.arm.home, "rad"),
        "reference": (model.arm.home, "rad"),
        **control_law.state,
    }
    if led_by_hand:
        state |= leading.STATE | {"tip_pose": (leading.pose_matrix(model), leading.TIP_POSE_UNIT)}
    x = _symbols(state)
    hand = casadi.SX.sym("hand", HAND_SIZE) if led_by_hand else None
    r = reference(command, q, x, p, period=period, hand=hand, model=model)
    torque, remembered = control_law.torque(Instant(model, q, v, wrench, r, x, p, period))
    reach = period * p["torque_rate"]
    torque = clamp(torque, x["torque"] - reach, x["torque"] + reach)
    following = {"torque": torque, **r.state, **remembered}
    inputs = {"measured": z, "perceived": environment, "wanted": command, **({} if hand is None else {"hand": hand})}
    return _system(
        "impl",
        following,
        state=state,
        x=x,
        gains=gains,
        p=p,
        inputs=inputs,
        period=period,
        compile=compile,
    )


def _make_act(arm: Arm, size: int) -> Diagram:
    """Return the system that adds ``offset`` to the torque, and saturates it at the limits of the joints.

    The torque is the first part of the state of ``impl``, whose size is ``size``.
    """
    builder = DiagramBuilder()
    limits = np.array(arm.torques)
    torque = builder.AddNamedSystem("torque", Demultiplexer([JOINTS, size - JOINTS]))
    offset = builder.AddNamedSystem("offset", ConstantVectorSource(np.zeros(JOINTS)))
    largest = LARGEST_OFFSETS["joint_torque_measured"]
    offset.variables = (Element("value", PARAMETER, 0, (JOINTS,), unit="N m", bounds=(-largest, largest)),)
    calibrated = builder.AddNamedSystem("calibrated", Adder(2, JOINTS))
    limited = builder.AddNamedSystem("limited", Saturation(-limits, limits))
    builder.ExportInput(torque.get_input_port(), "controlled")
    builder.Connect(torque.get_output_port(0), calibrated.get_input_port(0))
    builder.Connect(offset.get_output_port(), calibrated.get_input_port(1))
    builder.Connect(calibrated.get_output_port(), limited.get_input_port())
    builder.ExportOutput(limited.get_output_port(), "torque")
    return builder.Build()


def gravity_torque(model: ArmDynamics) -> np.ndarray:
    """Return the torque that holds the arm at home, shape (7,), in N m."""
    q = casadi.SX.sym("q", JOINTS)
    zero = casadi.SX(JOINTS, 1)
    hold = function("hold", {"q": q}, {"torque": model.inverse_dynamics(q, zero, zero)})
    return hold(model.arm.home).full().ravel()


def _symbols(declared: Mapping[str, tuple[object, ...]]) -> dict[str, Expression]:
    return {name: casadi.SX.sym(name, np.size(values[0])) for name, values in declared.items()}


def _system(
    name: str,
    following: dict[str, Expression],
    *,
    state: States,
    x: dict[str, Expression],
    gains: Declared,
    p: dict[str, Expression],
    inputs: dict[str, Expression],
    period: float,
    compile: bool,
) -> System:
    """Return the system x_next = following(x, p, inputs), with all its state in one vector, which is its output.

    Every group of a Context that Python reads and writes costs more than the arm's dynamics. The addresses of the state
    come from its parts.
    """
    parts = [x[name] for name in state]
    whole = casadi.SX.sym(_STATE, sum(part.numel() for part in parts))
    ends = np.cumsum([part.numel() for part in parts]).tolist()
    packed = casadi.vertcat(*(following[name] for name in state))
    (packed,) = casadi.substitute([packed], parts, casadi.vertsplit(whole, [0, *ends]))
    flat = {
        name: np.ravel(value) if np.size(value) > 1 else np.asarray(value).item() for name, (value, _) in state.items()
    }
    vector = NamedVector(**{name: Quantity(value, state[name][1]) for name, value in flat.items()})
    system = CasadiSystem(
        update=function(name, {_STATE: whole, **p, **inputs}, {f"{_STATE}_next": packed}),
        state={_STATE: vector.array()},
        parameters={name: value for name, (value, _, _) in gains.items()},
        period=period,
        units={name: unit for name, (_, unit, _) in gains.items()},
        bounds={name: bounds for name, (_, _, bounds) in gains.items()},
        compile=None if compile else False,
    )
    system.variables = (*(e for e in system.variables if e.name != _STATE), *vector.elements(DISCRETE, 0))
    return system
