"""Trials of the arm: a program of motions and its tracking errors, in simulation and on a machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from vtbdrake.common.arrays import rms
from vtbdrake.control.runtime import Runtime
from vtbdrake.testbed.addressed import AddressedDiagram
from vtbdrake_diagrams.manipulator.arm import JOINTS, Arm
from vtbdrake_diagrams.manipulator.dynamics import ArmDynamics, Expression, function
from vtbdrake_diagrams.manipulator.motions import Motion, parameters, reference
from vtbdrake_diagrams.manipulator.scenario import ManipulatorScenario

# The press meets the wall at this distance (m), and the swing does not.
WALL_DISTANCE = 0.835
DURATIONS = {
    "dps.impl.home_duration": 1.0,
    "dps.impl.swing_duration": 3.0,
    "dps.impl.circle_duration": 2.5,
    "dps.impl.press_duration": 3.0,
}
PROGRAM = (Motion.SWING, Motion.CIRCLE, Motion.PRESS)
FREE = (Motion.SWING, Motion.CIRCLE)

_STEP = 1e-4  # s, of the prediction's integration
_AT_REST = 1.0  # N/s; a force that changes less belongs to a rest
_WAITING = 1e-6  # m; a reference that is no further from the end of its press waits there


def trial_scenario(law: str) -> ManipulatorScenario:
    """Return the scenario of the arm in front of the wall."""
    return ManipulatorScenario(law=law, wall=True, wall_distance=WALL_DISTANCE)


class Trial:
    """A program of motions, one after another and then home, as the ``until`` of `Runtime.run`; it records samples.

    Args:
        runtime: The loop of the DPS; its context is changed.
        motions: The motions to command.
        every: The number of cycles between two samples.
    """

    def __init__(self, runtime: Runtime, motions: Sequence[int] = PROGRAM, *, every: int = 5) -> None:
        self._runtime = runtime
        self._target: AddressedDiagram = runtime.target
        self._context = runtime.context
        self._left = [*motions, Motion.HOME]
        self._every = every
        self._motion = self._target.reader("dps.impl.motion")
        self._readers = {name: self._target.reader(f"dps.{name}") for name in _RECORDED}
        self._samples: dict[str, list[Any]] = {name: [] for name in _RECORDED}
        self.parameters = {name: self._target.read(self._context, f"dps.impl.{name}") for name in parameters(Arm())}
        self._command(self._left[0])

    def __call__(self) -> bool:
        """Command the next motion if it is due, record a sample, and return whether the trial is done."""
        motion = int(self._motion(self._context))
        if self._left and motion == self._left[0]:
            del self._left[0]
            if self._left:
                self._command(self._left[0])
        if self._runtime.cycles % self._every == 0:
            for name, reader in self._readers.items():
                self._samples[name].append(np.array(reader(self._context)))
        return self.done

    def _command(self, motion: int) -> None:
        self._runtime.write({"u.motion": float(motion)})

    @property
    def done(self) -> bool:
        """True if the arm is on its way home."""
        return not self._left

    def track(self) -> Track:
        """Return the track until now."""
        return Track.of({name: np.array(values) for name, values in self._samples.items()}, self.parameters)


_RECORDED = ("env.joint_position", "env.contact_wrench", "impl.motion", "impl.clock", "impl.start", "impl.torque")


@dataclass(frozen=True)
class Track:
    """Reference and position of the tip, sample by sample.

    Attributes:
        motion: The motion under way, shape (n,).
        clock: The time since its begin, in s, (n,).
        reference: The reference of the tip, (n, 3), in m, in the world.
        tip: The position of the tip by the measured joint positions, (n, 3), in m.
        force: The force of the environment on the tip, as the DPS perceives it, (n, 3), in N.
        torque: The torque that the law commands, (n, 7), in N m.
    """

    motion: NDArray[np.float64]
    clock: NDArray[np.float64]
    reference: NDArray[np.float64]
    tip: NDArray[np.float64]
    force: NDArray[np.float64]
    torque: NDArray[np.float64]

    @classmethod
    def of(cls, samples: dict[str, NDArray[np.float64]], values: dict[str, Any], *, period: float = 0.001) -> Track:
        """Return the track from variables of the DPS; reference and position belong to the same update."""
        clock = samples["impl.clock"] - period
        positions = _positions(values, period)
        columns = [samples["impl.motion"], clock, samples["impl.start"], samples["env.joint_position"]]
        both = [positions(*row) for row in zip(*columns, strict=True)]
        reference_tip, tip = (np.array([pair[k].full().ravel() for pair in both]).reshape(-1, 3) for k in range(2))
        force = samples["env.contact_wrench"].reshape(-1, 6)[:, 3:]
        torque = samples["impl.torque"].reshape(-1, JOINTS)
        return cls(samples["impl.motion"], clock, reference_tip, tip, force, torque)

    def effort(self, motions: Sequence[int] = FREE) -> float:
        """Return the root mean square of the norm of the torques during some motions, in N m.

        Args:
            motions: The motions.
        """
        return rms(np.linalg.norm(self.torque[np.isin(self.motion, motions)], axis=1))

    def errors(self, motions: Sequence[int] = FREE) -> NDArray[np.float64]:
        """Return the distances of the tip from its reference during some motions, shape (k,), in m."""
        during = np.isin(self.motion, motions)
        tip_errors: NDArray[np.float64] = np.linalg.norm(self.tip[during] - self.reference[during], axis=1)
        return tip_errors

    def contact(self, law: LawAlongX, scenario: ManipulatorScenario) -> Contact:
        """Return the force during the press, and the prediction from law and wall."""
        during = self.motion == Motion.PRESS
        clock, along_x = self.clock[during], self.reference[during, 0]
        return Contact(clock, law.force(clock, along_x, scenario), -self.force[during, 0])

    def pressing(self, law: LawAlongX, scenario: ManipulatorScenario) -> RestingForce:
        """Return the force at which a press has come to rest: the mean over the last quarter of the wait at its end.

        Args:
            law: The behaviour of the arm along x, whose stiffness counts.
            scenario: The scenario of the wall.
        """
        press = np.flatnonzero(self.motion == Motion.PRESS)
        along_x = self.reference[press, 0]
        waiting = press[along_x > along_x.max() - _WAITING]
        last = waiting[-max(len(waiting) // 4, 1) :]
        predicted = law.static_force(self.reference[last, 0], scenario)
        return RestingForce(float(predicted.mean()), float(-self.force[last, 0].mean()))


@dataclass(frozen=True)
class LawAlongX:
    """The behaviour of the arm along the world's x under a Cartesian law, M x'' + D x' + K x = F.

    x is the distance from the reference.

    Attributes:
        inertia: M, in kg; 0 for the impedance law, which leaves the arm its own: it predicts statics.
        damping: D, in N s/m.
        stiffness: K, in N/m.
    """

    inertia: float
    damping: float
    stiffness: float

    @classmethod
    def of(cls, target: AddressedDiagram) -> LawAlongX:
        """Return the behaviour for the default gains of a target."""
        context, variables = target.default_context(), target.variables()
        values = {
            name: float(target.read(context, f"dps.impl.{name}")[3]) if f"dps.impl.{name}" in variables else 0.0
            for name in ("inertia", "damping", "stiffness")
        }
        return cls(**values)

    def static_force(self, along_x: NDArray[np.float64], scenario: ManipulatorScenario) -> NDArray[np.float64]:
        """Return the force on the wall at rest, of two springs in series, shape (n,), in N.

        Args:
            along_x: The reference of the tip along x, shape (n,), in m.
            scenario: The scenario of the wall.
        """
        k, depth = scenario.wall_stiffness, np.maximum(along_x - _face(scenario), 0.0)
        series: NDArray[np.float64] = self.stiffness * k / (self.stiffness + k) * depth
        return series

    def force(
        self, clock: NDArray[np.float64], along_x: NDArray[np.float64], scenario: ManipulatorScenario
    ) -> NDArray[np.float64]:
        """Return the force on the wall while the reference of the tip moves as ``along_x``, shape (n,), in N.

        Without inertia the stiffness of two springs in series; else of the mass against the wall, which pushes back by
        Hunt and Crossley's k d (1 + c d').
        """
        if self.inertia == 0.0:
            return self.static_force(along_x, scenario)
        beyond = along_x - _face(scenario)
        k, c = scenario.wall_stiffness, scenario.wall_dissipation
        fine = np.arange(clock[0], clock[-1], _STEP)
        depths = np.interp(fine, clock, beyond).tolist()
        speeds = np.interp(fine, clock, np.gradient(beyond, clock)).tolist()
        x = rate = 0.0
        forces = []
        for depth, speed in zip(depths, speeds, strict=True):
            push = max(0.0, k * max(0.0, depth + x) * (1.0 + c * (speed + rate)))
            rate -= _STEP * (push + self.stiffness * x + self.damping * rate) / self.inertia
            x += _STEP * rate
            forces.append(push)
        return np.interp(clock, fine, forces)


def _face(scenario: ManipulatorScenario) -> float:
    """Return where the tip meets the wall along x, in m."""
    return scenario.wall_distance - Arm().ball_radius


@dataclass(frozen=True)
class RestingForce:
    """The force on the wall at the end of a press.

    Attributes:
        predicted: By the statics of two springs in series: the law's and the wall's, in N.
        felt: As the DPS perceives it, in N.
    """

    predicted: float
    felt: float

    @property
    def error(self) -> float:
        """Return the difference from statics, as a share."""
        return abs(self.felt / self.predicted - 1.0)


@dataclass(frozen=True)
class Contact:
    """A press against the wall.

    Attributes:
        clock: The time since the begin of the motion, in s, (n,).
        predicted, felt: Force on the wall, in N, (n,).
    """

    clock: NDArray[np.float64]
    predicted: NDArray[np.float64]
    felt: NDArray[np.float64]

    def at(self, clock: float) -> tuple[float, float]:
        """Return the predicted and the measured force at an instant, in N."""
        k = self._index(clock)
        return float(self.predicted[k]), float(self.felt[k])

    @property
    def rests(self) -> NDArray[np.bool_]:
        """Return where the predicted force does not change, shape (n,)."""
        return np.abs(np.gradient(self.predicted, self.clock)) < _AT_REST

    def rests_at(self, clock: float) -> bool:
        """Return whether the predicted force does not change at an instant."""
        return bool(self.rests[self._index(clock)])

    def _index(self, clock: float) -> int:
        return int(np.abs(self.clock - clock).argmin())


def run_trial(runtime: Runtime, motions: Sequence[int] = PROGRAM, *, limit: float = 60.0) -> Track:
    """Run a loop until its DPS has done the motions, and return the track.

    Args:
        runtime: The loop.
        motions: The motions to command.
        limit: The longest duration, in seconds of cycles.

    Raises:
        TimeoutError: The motions took longer.
    """
    trial = Trial(runtime, motions)
    runtime.run(until=trial, cycles=round(limit / runtime.period))
    if not trial.done:
        raise TimeoutError(
            f"the motions {', '.join(Motion(motion).label for motion in motions)} took longer than {limit} s"
        )
    return trial.track()


def _positions(values: dict[str, Any], period: float) -> Any:
    """Return the function (motion, clock, start, q) -> (reference of the tip, tip)."""
    model = ArmDynamics()
    symbols: dict[str, Expression] = {
        "motion": casadi.SX.sym("motion"),
        "clock": casadi.SX.sym("clock"),
        "start": casadi.SX.sym("start", JOINTS),
        "q": casadi.SX.sym("q", JOINTS),
    }
    state = {**{name: symbols[name] for name in ("motion", "clock", "start")}, "reference": symbols["start"]}
    parameters = {name: casadi.SX(np.atleast_1d(value)) for name, value in values.items()}
    r = reference(symbols["motion"], symbols["q"], state, parameters, period=period)
    reference_tip, tip = model.tip(r.q).p + r.dp, model.tip(symbols["q"]).p
    return function("positions", symbols, {"reference": reference_tip, "tip": tip})
