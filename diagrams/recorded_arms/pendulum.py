"""DFKI's torque-limited pendulum as a testbed: a rod with a weight on one motor. What its recordings say."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RevoluteJoint, RotationalInertia, SpatialInertia

import vtbdrake as vtb
from vtbdrake.calibration import Calibration, JointRecording, TorqueRegressor, calibrate, equations, regress
from vtbdrake.common.arrays import Array
from vtbdrake.common.settings import setting
from vtbdrake.recording import Log
from vtbdrake_diagrams.recorded_arms import plants
from vtbdrake_diagrams.torque_driven import TorqueDrivenScenario

BODY = "sim.sys.pendulum.rod"
DRIVES = "sim.act.drives"
HORIZON = 0.3
"""Duration of a prediction, in s."""
IDENTIFICATION = "control_method_pd/system_identification"
HELD_OUT = {"energy shaping": "control_method_energy_shaping", "iLQR": "control_method_ilqr"}
RANGES = {
    f"{BODY}.center_of_mass[2]": (-1.5, -0.02),
    f"{BODY}.inertia[1]": (1e-4, 0.3),
    f"{DRIVES}.viscous[0]": (0.0, 0.5),
    f"{DRIVES}.coulomb[0]": (0.0, 1.0),
}
"""The numbers that are calibrated, with their ranges."""
FIT_PERIOD = 0.02
"""The time between two positions of the fit, in s."""
# A window is predicted if its largest speed exceeds this one, in rad/s.
_SLOWEST = 1.0
# Steps of the integration within a period of a published model: its friction is steep.
_SUBSTEPS = 4
# Velocity scale of its Coulomb friction, in rad/s.
_STEEP = 0.02
# Duration over which velocities are smoothed, in s.
_SMOOTHED = 0.06


@dataclass
class TorqueLimitedPendulumScenario(TorqueDrivenScenario):
    """A rod with a weight on one motor; its numbers are guesses, to be calibrated.

    F. Wiebe and others, "Torque-limited simple pendulum", Journal of Open Source Software 7(74), 2022.
    """

    size = 1

    period: float = setting(0.005, "The sample period of sensors, DPS and drive.", unit="s", gt=0)
    torque_limit: float = setting(20.0, "The largest torque of the motor.", unit="N m", gt=0)
    mass: float = setting(0.5, "Mass.", unit="kg", gt=0)
    center: float = setting(0.3, "From the motor to the centre of mass.", unit="m", gt=0)
    moment: float = setting(0.02, "Moment about the centre of mass.", unit="kg m^2", gt=0)
    viscous: float = setting(0.02, "Viscous friction of the drive.", unit="N m s/rad", ge=0)
    coulomb: float = setting(0.1, "Coulomb friction of the drive.", unit="N m", ge=0)

    def add_links(self, plant: MultibodyPlant) -> list[RevoluteJoint]:
        instance = plant.AddModelInstance("pendulum")
        inertia = SpatialInertia.MakeFromCentralInertia(
            self.mass, [0.0, 0.0, -self.center], RotationalInertia(self.moment, self.moment, self.moment)
        )
        link = plant.AddRigidBody("rod", instance, inertia)
        joint = plant.AddJoint(RevoluteJoint("pivot", plant.world_frame(), link.body_frame(), [0.0, 1.0, 0.0]))
        plant.AddJointActuator("motor", joint, self.torque_limit)
        return [joint]


@dataclass(frozen=True)
class PendulumModel:
    """J qdd + m c g sin q + viscous qd + coulomb tanh(qd / 0.02) + offset = torque.

    Attributes:
        J: Inertia about the motor, in kg m^2.
        moment: m c, in kg m.
        viscous: In N m s/rad.
        coulomb: In N m.
        offset: In N m.
    """

    J: float
    moment: float
    viscous: float
    coulomb: float
    offset: float = 0.0

    def predicted(self, q: float, v: float, torques: Array, period: float) -> Array:
        """Return the positions after each of the torques, (n,)."""
        h, positions = period / _SUBSTEPS, []
        for torque in torques:
            for _ in range(_SUBSTEPS):
                friction = self.viscous * v + self.coulomb * np.tanh(v / _STEEP) + self.offset
                v += h * (torque - self.moment * 9.81 * np.sin(q) - friction) / self.J
                q += h * v
            positions.append(q)
        return np.array(positions)


# The published friction is 0.1839 atan(100 v), which becomes pi / 2 times that.
PUBLISHED = PendulumModel(J=0.06259, moment=0.1022, viscous=0.04707, coulomb=0.1839 * np.pi / 2.0, offset=-0.07586)
WEIGHED = 0.6755, 0.5
"""The mass (kg) and the length (m) with which the authors' controllers compensate gravity, and hold still."""


def recordings(folder: Path, name: str) -> Log:
    """Return one of the recorded runs."""
    return read(folder / "results" / name / "data_measured.csv")


def read(path: Path) -> Log:
    """Return the run of a file."""
    sense = {"joint_position": "position", "joint_velocity": "velocity"}
    return vtb.read_table(path, sense=sense, act={"torque": "torque"})


def calibrated(log: Log) -> tuple[Calibration, PendulumModel]:
    """Return the calibration, and the same as a `PendulumModel`.

    With the mass at its guess, centre and moment say all that a pendulum depends on.
    """
    result = calibrate(
        TorqueLimitedPendulumScenario(),
        log,
        [vtb.Parameter(address, *ends) for address, ends in RANGES.items()],
        position="joint_position",
        torque="torque",
        measured_torque=True,
        period=FIT_PERIOD,
    )
    center, moment, viscous, coulomb = (result.parameters[address].value for address in RANGES)
    mass = TorqueLimitedPendulumScenario().mass
    return result, PendulumModel(moment + mass * center**2, -mass * center, viscous, coulomb)


def prediction_errors(log: Log, model: PendulumModel) -> Array:
    """Return root mean squares in rad of predictions over `HORIZON`, wherever the pendulum moves."""
    times, q = log.sense["joint_position"].times, log.sense["joint_position"].values[:, 0]
    torques, period = log.act["torque"].at(times)[:, 0], float(np.median(np.diff(times)))
    window = max(round(_SMOOTHED / period) | 1, 5)
    smooth, v = (scipy.signal.savgol_filter(q, window, 3, deriv=k, delta=period) for k in (0, 1))
    steps, errors = round(HORIZON / period), []
    for k in range(10, len(q) - steps - 10, steps):
        span = slice(k, k + steps)
        if np.isfinite(torques[span]).all() and abs(v[span]).max() > _SLOWEST:
            expected = model.predicted(smooth[k], v[k], torques[span], period)
            errors.append(np.sqrt(np.mean((expected - q[k + 1 : k + steps + 1]) ** 2)))
    return np.array(errors)


def published_procedure(log: Log) -> PendulumModel:
    """Return what the authors' own steps make of a run: filters of their own for each term of one regression."""
    times, torque = log.act["torque"].times, log.act["torque"].values[:, 0]
    q, velocity = (log.sense[name].values[:, 0] for name in ("joint_position", "joint_velocity"))

    def filtered(values: Array, cutoff: float) -> Array:
        return np.asarray(scipy.signal.filtfilt(*scipy.signal.butter(3, cutoff), values))

    v, a = np.gradient(q, times), filtered(np.gradient(filtered(velocity, 0.2), times), 0.1)
    terms = np.column_stack([a, 9.81 * np.sin(q), v, np.arctan(100.0 * v), np.ones(len(q))])
    J, moment, viscous, coulomb, offset = np.linalg.lstsq(terms, filtered(torque, 0.1), rcond=None)[0]
    return PendulumModel(J, moment, viscous, 0.5 * np.pi * coulomb, offset)


def by_inverse_dynamics(log: Log) -> PendulumModel:
    """Return what one regression makes of a run whose both sides pass the same filter."""
    model = TorqueRegressor(plants.pendulum())
    position, torque = log.sense["joint_position"], log.act["torque"]
    recording = JointRecording(log.source, position.times, position.values, torque.values)
    p = regress(model, equations(model, recording, cutoff=15.0, band=5.0)).parameters
    value = dict(zip(model.names, p, strict=True))
    friction = (value[f"link.{term}"] for term in ("viscous", "coulomb", "offset"))
    return PendulumModel(value["link.Iyy"], -value["link.mz"], *friction)


def models(folder: Path) -> tuple[Calibration, dict[str, PendulumModel]]:
    """Return the calibration, and the models that are compared."""
    log = recordings(folder, IDENTIFICATION)
    result, ours = calibrated(log)
    mass, length = WEIGHED
    weighed = PendulumModel(mass * length**2, mass * length, ours.viscous, ours.coulomb)
    return result, {
        "calibrated": ours,
        "inverse dynamics": by_inverse_dynamics(log),
        "published": PUBLISHED,
        "their procedure": published_procedure(log),
        "as weighed": weighed,
    }


def median_errors(folder: Path, model: PendulumModel) -> list[float]:
    """Return the median errors in rad of predictions of the runs that are held out."""
    return [float(np.median(prediction_errors(recordings(folder, run), model))) for run in HELD_OUT.values()]


def report(folder: Path) -> None:
    """Print the calibration, and the predictions of other runs."""
    result, by_name = models(folder)
    print(result)
    print(f"\nmedian error in rad of predictions over {HORIZON:g} s of other runs: {', '.join(HELD_OUT)}")
    print(f"{'':16}{'m c':>8}{'J':>8}")
    for name, model in by_name.items():
        errors = "".join(f"{error:10.4f}" for error in median_errors(folder, model))
        print(f"{name:16}{model.moment:8.4f}{model.J:8.4f}{errors}")
