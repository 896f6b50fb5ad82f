"""The equations of this package's own systems, but for the plant."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import inf, sqrt
from typing import Any

import casadi
import numpy as np
from pydrake.systems.framework import Context, System

from vtbdrake.common.arrays import Array
from vtbdrake.compiled.equations import At, Draw, Equations, Expression, Fixed, Timing, refusal
from vtbdrake.components.casadi_system.function_ports import INPUT, PARAMETER, STATE, FunctionResult, Model
from vtbdrake.components.casadi_system.rotations import quaternion, rotation_matrix
from vtbdrake.components.sensors import errors as sensor_errors
from vtbdrake.components.sensors.noise import noise_of_seeds

# As a SplineCommand rounds.
_ROUNDING = 1e-9
# An Imu takes a turn between two samples for 0 whose half has a smaller sine.
_SMALLEST_SINE = 1e-12


class CasadiEquations(Equations):
    """A `CasadiSystem`."""

    def __init__(self, system: Any, context: Context, varied: frozenset[str]) -> None:
        super().__init__(system, context, varied)
        self._model: Model = system.model

    def output(self, port: str, at: At) -> Expression:
        return self._value(self._model.outputs[port], at)

    def update(self, at: At) -> dict[int, Expression]:
        model = self._model
        if model.update is None:
            return {}
        ends = np.cumsum([0, *(model.size(name) for name in model.state)]).tolist()
        return dict(enumerate(casadi.vertsplit(self._value(model.update, at), ends)))

    def _value(self, result: FunctionResult, at: At) -> Expression:
        arguments = []
        for block in result.blocks:
            if block.source == PARAMETER:
                ends = np.cumsum([0, *(self._model.size(name) for name in block.names)]).tolist()
                arguments += casadi.vertsplit(at.parameter(0), ends)
            elif block.source == STATE:
                arguments.append(at.state(self._model.state_index(block.names[0])))
            else:
                arguments.append(at.input(block.names[0]) if block.source == INPUT else at.time)
        try:
            return casadi.densify(result.kernel.expression(arguments))
        except RuntimeError as error:
            raise refusal(
                self.system, f"is no function of scalar operations ({str(error).splitlines()[-1]}): keep it in Drake"
            ) from None


class SplineEquations(Equations):
    """A `SplineCommand`."""

    def output(self, port: str, at: At) -> Expression:
        return at.state(0)

    def update(self, at: At) -> dict[int, Expression]:
        system: Any = self.system
        spline, plan, before = system.spline, at.input("plan"), at.state(0)
        late = at.time - plan[0]
        t = late
        if system.repeat:
            t = casadi.fmod(t + _ROUNDING, spline.duration) - _ROUNDING
        within = casadi.fmin(casadi.fmax(t, 0.0), spline.duration)
        value = _spline_value(spline, within, casadi.reshape(plan[1:], before.numel(), spline.knots).T)
        if system.after is not None:
            value = casadi.if_else(t > spline.duration + _ROUNDING, casadi.SX(system.after), value)
        value = casadi.if_else(late < -_ROUNDING, before, value)
        # The system raises.
        return {0: casadi.if_else(casadi.sumsqr(plan) < inf, value, casadi.SX.nan(value.numel(), 1))}


def _spline_value(spline: Any, t: Expression, knots: Expression) -> Expression:
    """Return the value at ``t``, shape (m, 1), of knots of shape (n, m)."""
    pieces = spline.pieces
    i = casadi.fmin(casadi.floor(t / spline.step + _ROUNDING), len(pieces) - 1)
    s = casadi.fmax(t - i * spline.step, 0.0)
    powers = [casadi.SX(1.0), s, s * s, s * s * s]
    value = casadi.SX(knots.shape[1], 1)
    for k in range(pieces.shape[1]):
        if pieces[:, k].any():
            at_pieces = casadi.sparsify(casadi.SX(casadi.DM(pieces[:, k]))) @ knots
            selected = sum(casadi.if_else(i == piece, at_pieces[piece, :].T, 0.0) for piece in range(len(pieces)))
            value += powers[k] * selected
    return value


class SensorEquations(Equations):
    """A `SampledSensor`: what it measures is said by ``measure``, its `ErrorModel` is the same for all.

    A sensor's memory for the next measurement is not covered, and its standard deviations, drift, quantization,
    drop-out and outliers are left out where they are 0.

    Args:
        measure: Returns the measurement without errors, as an expression.
    """

    def __init__(self, system: Any, context: Context, varied: frozenset[str], measure: Callable[[At], Expression]):
        super().__init__(system, context, varied)
        self._measure = measure
        self._errors: sensor_errors.ErrorStage | None = system.errors
        self._present: dict[str, bool] = {}
        if self._errors is None:
            return
        values = self._errors.parameters.view(context)
        names = [*self._errors.noise]
        if self._errors.has_model:
            names += ["drift", "quantization", "dropout", "outlier_probability"]
            self._latency = round(values.latency)
        self._present = {name: name in varied or bool(np.any(getattr(values, name))) for name in names}
        if "outlier_size" in varied and "outlier_probability" in self._present:
            self._present["outlier_probability"] = True
        n = context.get_discrete_state(0).size()
        if any(self._present[name] for name in self._errors.noise):
            self.draws["noise"] = self._draw(n, channel=0)
        if self._present.get("drift"):
            self.draws["drift"] = self._draw(n, channel=1)
        if self._present.get("dropout"):
            self.draws["dropout"] = self._draw(1, channel=2, normal=False)
        if self._present.get("outlier_probability"):
            self.draws["outlier"] = self._draw(1, channel=3, normal=False)
            self.draws["outlier_size"] = self._draw(n, channel=4)

    def fixed(self) -> Iterator[Fixed]:
        if self._errors is None:
            return
        vector, group = self._errors.parameters.vector, int(self._errors.parameters.index)
        for name, present in self._present.items():
            if not present:
                yield Fixed(group, vector.slice_of(name), "it is 0, and left out: name it in parameters=")
        if self._errors.has_model:
            yield Fixed(group, vector.slice_of("latency"), "a latency is compiled in")

    def output(self, port: str, at: At) -> Expression:
        return at.state(0)

    def update(self, at: At) -> dict[int, Expression]:
        y, errors = self._measure(at), self._errors
        if errors is None:
            return {0: y}
        vector = errors.parameters.vector
        parameters = at.parameter(int(errors.parameters.index))

        def value(name: str) -> Expression:
            return parameters[vector.slice_of(name)]

        if "noise" in self.draws:
            deviations = casadi.vertcat(*(casadi.repmat(value(name), count) for name, count in errors.noise.items()))
            y = y + deviations * at.draw("noise")
        return self._shown(at, y, value) if errors.has_model else {0: y}

    def _shown(self, at: At, y: Expression, value: Callable[[str], Expression]) -> dict[int, Expression]:
        errors, present, n = self._errors, self._present, y.numel()
        assert errors is not None and self.timing is not None
        group = int(errors.memory.index)
        memory = at.state(group)
        walk = memory[:n]
        if present["drift"]:
            walk = walk + sqrt(self.timing.period) * value("drift") * at.draw("drift")
        if present["outlier_probability"]:
            size = value("outlier_size") * at.draw("outlier_size")
            y = y + casadi.if_else(at.draw("outlier") < value("outlier_probability"), size, 0.0)
        y = y + value("bias") + walk
        if present["quantization"]:
            q = value("quantization")
            y = casadi.if_else(q > 0.0, _rounded(y / casadi.if_else(q > 0.0, q, 1.0)) * q, y)
        remembered = [walk]
        if errors.longest:
            in_transit, newest = memory[n:], y
            if self._latency:
                y = in_transit[(self._latency - 1) * n : self._latency * n]
            remembered += [newest, in_transit[:-n]]
        if present["dropout"]:
            y = casadi.if_else(at.draw("dropout") < value("dropout"), at.state(0), y)
        return {0: y, group: casadi.vertcat(*remembered)}

    def _draw(self, size: int, *, channel: int, normal: bool = True) -> Draw:
        errors, timing = self._errors, self.timing
        assert errors is not None and timing is not None
        place = int(errors.parameters.index), errors.parameters.vector.slice_of("seed").start

        def numbers(seeds: Array, times: Array) -> Array:
            return noise_of_seeds(
                size,
                seeds=seeds.astype(np.uint64),
                stream=errors.stream(),
                ticks=np.rint(times / timing.period).astype(np.int64),
                channel=channel,
                normal=normal,
            )

        return Draw(size, place, numbers)


def _rounded(x: Expression) -> Expression:
    """Return the nearest whole number, of two the even one, as numpy does."""
    below = casadi.floor(x)
    rest, is_odd = x - below, below - 2.0 * casadi.floor(below / 2.0)
    up = casadi.logic_or(rest > 0.5, casadi.logic_and(rest == 0.5, is_odd == 1.0))
    return below + up


class JointSensorEquations(SensorEquations):
    """Sensors of entries of the state: `JointEncoders`, `JointTachometers`, `BasePoseSensor`, `BaseTwistSensor`."""

    def __init__(self, system: Any, context: Context, varied: frozenset[str]) -> None:
        entries = system.entries.tolist()
        super().__init__(system, context, varied, lambda at: at.input("state")[entries])


class ImuEquations(SensorEquations):
    """An `Imu`."""

    def __init__(self, system: Any, context: Context, varied: frozenset[str]) -> None:
        super().__init__(system, context, varied, lambda at: self._sample(at)[0])

    def update(self, at: At) -> dict[int, Expression]:
        system: Any = self.system
        return {**super().update(at), int(system.memory.index): self._sample(at)[1]}

    def _sample(self, at: At) -> tuple[Expression, Expression]:
        return at.shared("sample", lambda: self._new_sample(at))

    def _new_sample(self, at: At) -> tuple[Expression, Expression]:
        """Return the measurement and the memory of it."""
        system: Any = self.system
        mount = at.parameter(int(system.settings.index))[system.settings.vector.slice_of("mount")]
        memory = at.state(int(system.memory.index))
        sampled, last_v, last_q = memory[0], memory[1:4], memory[4:]
        q_WB, w_WB, v_WB = self._motion(at)
        R_WB = rotation_matrix(q_WB)
        v_WF = v_WB + casadi.cross(w_WB, R_WB @ mount[:3])
        q_WF = _product(q_WB, _quaternion_of_roll_pitch_yaw(mount[3:]))
        at_rest = -rotation_matrix(q_WF).T @ casadi.DM(system.gravity)
        force = (v_WF - last_v) / system.period - casadi.DM(system.gravity)
        # q and -q are the same orientation.
        last_q = casadi.if_else(casadi.dot(last_q, q_WF) < 0.0, -last_q, last_q)
        turn = _product(casadi.vertcat(last_q[0], -last_q[1:]), q_WF)
        sine = casadi.norm_2(turn[1:])
        angle = casadi.if_else(sine > _SMALLEST_SINE, 2.0 * casadi.atan2(sine, turn[0]) / sine, 2.0)
        middle = last_q + q_WF
        R_mid = rotation_matrix(middle / casadi.norm_2(middle))
        moving = casadi.vertcat(angle / system.period * turn[1:], R_mid.T @ force)
        reading = casadi.if_else(sampled != 0.0, moving, casadi.vertcat(casadi.SX.zeros(3, 1), at_rest))
        return reading, casadi.vertcat(1.0, v_WF, q_WF)

    def _motion(self, at: At) -> tuple[Expression, Expression, Expression]:
        """Return q_WB (wxyz), w_WB and v_WB."""
        system: Any = self.system
        if system.floating_places is None:
            R, _ = at.input("body_poses")(system.body)
            V = at.input("body_spatial_velocities")(system.body)
            return quaternion(R), V[:3], V[3:]
        x, (orientation, velocity) = at.input("state"), system.floating_places
        q = x[orientation : orientation + 4]
        return q / casadi.norm_2(q), x[velocity : velocity + 3], x[velocity + 3 : velocity + 6]


def _quaternion_of_roll_pitch_yaw(rpy: Expression) -> Expression:
    """Return the quaternion of Rz(yaw) Ry(pitch) Rx(roll), (4, 1)."""
    c, s = casadi.cos(rpy / 2), casadi.sin(rpy / 2)
    x, y, z = (casadi.vertcat(c[k], *(s[k] if axis == k else casadi.SX(0) for axis in range(3))) for k in range(3))
    return _product(z, _product(y, x))


def _product(a: Expression, b: Expression) -> Expression:
    """Return the product of two quaternions, (4, 1)."""
    return casadi.vertcat(
        a[0] * b[0] - casadi.dot(a[1:], b[1:]), a[0] * b[1:] + b[0] * a[1:] + casadi.cross(a[1:], b[1:])
    )


class JointTorqueEquations(SensorEquations):
    """`JointTorqueSensors`."""

    def __init__(self, system: Any, context: Context, varied: frozenset[str]) -> None:
        motions = [motion.get_coeffs().reshape(1, -1) for motion in system.motions]

        def measure(at: At) -> Expression:
            reaction = at.input("reaction_forces")
            return casadi.vertcat(*(casadi.DM(m) @ reaction(k) for k, m in zip(system.places, motions, strict=True)))

        super().__init__(system, context, varied, measure)


class ForceTorqueEquations(SensorEquations):
    """`ForceTorqueSensor`."""

    def __init__(self, system: Any, context: Context, varied: frozenset[str]) -> None:
        super().__init__(system, context, varied, lambda at: -at.input("reaction_forces")(system.place))


class ContactEquations(SensorEquations):
    """`ContactSensor`."""

    def __init__(self, system: Any, context: Context, varied: frozenset[str]) -> None:
        settings = system.settings

        def measure(at: At) -> Expression:
            load = at.input("contact_results")
            threshold = at.parameter(int(settings.index))[settings.vector.slice_of("threshold")]
            return casadi.vertcat(*(casadi.SX(load(body) > threshold) for body in system.body_indices))

        super().__init__(system, context, varied, measure)


class DriveEquations(Equations):
    """`JointDrives`, whose delay is compiled in; a disturbance that is 0 is left out."""

    def __init__(self, system: Any, context: Context, varied: frozenset[str]) -> None:
        super().__init__(system, context, varied)
        self.timing = Timing(system.period)
        self._vector = system.settings.vector
        values = context.get_numeric_parameter(0).value()
        self._delay = round(float(values[-1]))
        self._is_disturbed = "disturbance" in varied or bool(values[self._vector.slice_of("disturbance")].any())
        if self._is_disturbed:
            self.draws["disturbance"] = Draw(system.n, (0, self._vector.slice_of("seed").start), self._noise)

    def _noise(self, seeds: Array, times: Array) -> Array:
        system: Any = self.system
        ticks = np.rint(times / system.period).astype(np.int64)
        return noise_of_seeds(system.n, seeds=seeds.astype(np.uint64), stream=system.stream(), ticks=ticks)

    def fixed(self) -> Iterator[Fixed]:
        yield Fixed(0, slice(-1, None), "a delay is compiled in")
        if not self._is_disturbed:
            place = self._vector.slice_of("disturbance")
            yield Fixed(0, place, "it is 0, and left out: name it in parameters=")

    def output(self, port: str, at: At) -> Expression:
        system: Any = self.system
        return self._torque(at, at.state(1)) if system.step > 0.0 else at.state(0)

    def updates(self) -> Iterator[tuple[Timing, Callable[[At], dict[int, Expression]]]]:
        system: Any = self.system
        when = Timing(system.period)
        if system.step > 0.0:
            yield Timing(system.step), lambda at: self._last(at, self.output("torque", at))
            yield when, self._motors
        else:
            yield when, self._all

    def _torque(self, at: At, memory: Expression) -> Expression:
        n = self.system.n
        arguments = [at.parameter(0), memory[:n], memory[-n:], at.state(0), at.state(2), at.input("state")]
        return casadi.densify(self.system.kernel.expression(arguments))

    def _last(self, at: At, torque: Expression) -> dict[int, Expression]:
        return {0: torque, 2: casadi.vertcat(at.input("state")[self.system.velocities], 1.0)}

    def _motors(self, at: At) -> dict[int, Expression]:
        system: Any = self.system
        delayed = u = at.input("command")
        n, memory = system.n, at.state(1)
        in_transit = memory[2 * n : -n]
        if self._delay:
            delayed = in_transit[(self._delay - 1) * n : self._delay * n]
        following = system.motors.expression([at.parameter(0), memory[: 2 * n], delayed])
        shifted = casadi.vertcat(u, in_transit[:-n]) if system.max_delay else casadi.SX(0, 1)
        return {1: casadi.vertcat(following, shifted, self._disturbing_torque(at, memory[-n:]))}

    def _disturbing_torque(self, at: At, before: Expression) -> Expression:
        if not self._is_disturbed:
            return casadi.SX.zeros(before.numel(), 1)
        system: Any = self.system
        values = at.parameter(0)
        deviation, time = (values[self._vector.slice_of(name)] for name in ("disturbance", "disturbance_time"))
        # The division by 0 gives exp(-inf) = 0.
        decay = casadi.if_else(at.state(2)[-1] > 0.5, casadi.exp(-system.period / time), 0.0)
        return decay * before + casadi.sqrt(1.0 - decay**2) * deviation * at.draw("disturbance")

    def _all(self, at: At) -> dict[int, Expression]:
        following = self._motors(at)
        return {**following, **self._last(at, self._torque(at, following[1]))}


class CandidateEquations(Equations):
    """The `OnboardReasoner` of a mental copy: it shows its parameter ``candidate`` at the instant of a decision."""

    may_be_infinite = True  # No decision has a time or a quality.

    def __init__(self, system: Any, context: Context, varied: frozenset[str]) -> None:
        super().__init__(system, context, varied)
        if not system.mental:
            raise refusal(system, "reasons itself: give it mental=True in a mental copy")
        self.timing = Timing(system.period, system.due(0), unrestricted=True)

    def output(self, port: str, at: At) -> Expression:
        system: Any = self.system
        return at.state(system.groups[port])

    def updates(self) -> Iterator[tuple[Timing, Callable[[At], dict[int, Expression]]]]:
        system: Any = self.system
        if system.on_request:
            yield Timing(system.period, system.sampled(0), unrestricted=True), self._take_request
        yield from super().updates()

    def _take_request(self, at: At) -> dict[int, Expression]:
        return self._of_candidate(at, 0.0, {"taken": at.input("request")})

    def update(self, at: At) -> dict[int, Expression]:
        system: Any = self.system
        candidate = at.parameter(system.candidate_groups[0])
        sampled_at = self._sampled_at(at, system.latency)
        return self._of_candidate(at, system.latency, {"decision": candidate, "sampled_at": sampled_at, "valid": 1.0})

    def _sampled_at(self, at: At, delay: float) -> Expression:
        """Return the time when the sample was due that was taken ``delay`` seconds ago."""
        system: Any = self.system
        return system.offset + casadi.floor((at.time - system.offset - delay) / system.period + 0.5) * system.period

    def _of_candidate(self, at: At, delay: float, shown: dict[str, Expression]) -> dict[int, Expression]:
        """Return new values of ports if the sample taken ``delay`` seconds ago is the candidate's."""
        system: Any = self.system
        candidate_at = at.parameter(system.candidate_groups[1])
        is_shown = casadi.fabs(candidate_at - self._sampled_at(at, delay)) < 0.5 * system.period
        groups = system.groups
        return {groups[name]: casadi.if_else(is_shown, value, at.state(groups[name])) for name, value in shown.items()}


class BoardEquations(Equations):
    """The board of the switches and commands: its positions are compiled in, its constants are state."""

    may_be_infinite = True

    def __init__(self, system: System, context: Context, varied: frozenset[str]) -> None:
        super().__init__(system, context, varied)
        positions = self.compiled_in(context)
        names = [system.get_output_port(i).get_name() for i in range(system.num_output_ports())]
        self._positions = dict(zip(names, positions, strict=False))
        self._groups = {name: i for i, name in enumerate(names[len(positions) :])}

    def output(self, port: str, at: At) -> Expression:
        return self._positions[port] if port in self._positions else at.state(self._groups[port])

    def compiled_in(self, context: Context) -> list[int]:
        return [int(context.get_abstract_state(i).get_value()) for i in range(context.num_abstract_states())]

    def refused(self, name: str) -> str:
        return "the positions of the switches are compiled in"
