"""The recordings of arms and legs, with models that others have published on them.

Each function reads a folder of recordings (see docs/reality_arms.md for their sources) and returns a `Subject`.
"""

from __future__ import annotations

import csv
import re
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import scipy.io

from vtbdrake.calibration import DriveModel, JointRecording, RegressionEquations, TorqueRegressor, equations, friction
from vtbdrake.common.arrays import Array
from vtbdrake.testbed.inertia import INERTIA_SIZE
from vtbdrake_diagrams.recorded_arms import plants

Prediction = Callable[[RegressionEquations], Array]


@dataclass(frozen=True, eq=False)
class Subject:
    """A robot with recordings.

    Attributes:
        name: Its name.
        model: Its inverse dynamics.
        fitted: The equations of the fit.
        held_out: Those of other movements.
        published: Torques (n, nq) that published models expect, by their names.
        runs: Parts of the recordings, to compare their estimates.
        joints: Those whose torques are compared, if not all.
        block: Duration of a block of the intervals, in s.
        prior: Relative deviation of the plant's own inertias, see `regress`; None for those that are published results.
        published_saw_all: What is held out here was part of the published fit.
    """

    name: str
    model: TorqueRegressor
    fitted: tuple[RegressionEquations, ...]
    held_out: tuple[RegressionEquations, ...]
    published: Mapping[str, Prediction]
    runs: tuple[tuple[RegressionEquations, ...], ...]
    joints: Sequence[int] | None = None
    block: float = 0.25
    prior: float | None = 0.3
    published_saw_all: bool = False


def by_parameters(model: TorqueRegressor, values: Mapping[str, float], *, nominal: bool = False) -> Prediction:
    """Return the torques by parameters; those without a value are zero, or with ``nominal`` the plant's."""
    everything = {} if nominal else dict.fromkeys(model.names, 0.0)
    p = model.vector(everything | dict(values))
    return lambda each: np.asarray(each.Y @ p)


def with_fitted_friction(
    model: TorqueRegressor, inertial: Prediction, fitted: Sequence[RegressionEquations]
) -> Prediction:
    """Return torques by inertias that are published, with friction that fits what they leave of each joint."""
    first = INERTIA_SIZE * len(model.bodies)
    Y = np.concatenate([each.Y[:, :, first:] for each in fitted])
    left = np.concatenate([each.tau - inertial(each) for each in fitted])
    scale = left.std(axis=0)
    p = np.linalg.lstsq((Y / scale[:, np.newaxis]).reshape(-1, Y.shape[2]), (left / scale).ravel(), rcond=None)[0]
    return lambda each: inertial(each) + each.Y[:, :, first:] @ p


def _split(each: RegressionEquations, parts: int) -> tuple[tuple[RegressionEquations], ...]:
    edges = np.linspace(each.times[0], each.times[-1] + 1e-9, parts + 1)
    return tuple((each.between(a, b),) for a, b in pairwise(edges))


# -- Franka's Panda


def panda_recording(folder: Path) -> JointRecording:
    """Return the recording of Franka's Panda: 21 s at 1 kHz, torques by the joints' sensors."""
    log = folder / "matlab/data/Exciting_Traj/Trajectory_1/rbt_log"
    times = np.loadtxt(log / "exciting_traj_time.txt")
    q, tau = (np.loadtxt(log / f"exciting_traj_{name}.txt").reshape(-1, 7) for name in ("positions", "torques"))
    # There is one time more than positions.
    return JointRecording("panda", times[: len(q)], q, tau)


def panda(folder: Path) -> Subject:
    """Franka's Panda (C. Gaz and others, RA-L 2019)."""
    # Behind the gears, the sensors do not feel the rotors.
    drives = {f"link{k + 1}": DriveModel(row, friction(rotor=False)) for k, row in enumerate(np.eye(7))}
    model = TorqueRegressor(plants.panda(), drives=drives)
    each = equations(model, panda_recording(folder), cutoff=25.0, band=8.0)
    law = (0.54615, 0.87224, 0.64068, 1.2794, 0.83904, 0.30301, 0.56489)
    shift = (0.039533, 0.025882, -0.04607, 0.036194, 0.026226, -0.021047, 0.0035526)
    steep = (5.1181, 9.0657, 10.136, 5.5903, 8.3469, 17.133, 10.336)
    inertial = by_parameters(model, {}, nominal=True)

    def gaz(part: RegressionEquations) -> Array:
        v = np.stack([part.Y[:, k, model.names.index(f"link{k + 1}.viscous")] for k in range(7)], axis=1)
        A, s, k = np.array(law), np.array(shift), np.array(steep)
        return inertial(part) + A / (1.0 + np.exp(-k * (v + s))) - A / (1.0 + np.exp(-k * s))

    fitted, held_out = each.between(0.0, 14.0), each.between(14.0, 22.0)
    return Subject("Panda", model, (fitted,), (held_out,), {"Gaz 2019": gaz}, _split(each, 2), prior=None)


# -- Staubli TX40

_TX40_PERIOD = 2e-4
_TX40_END = 7.4  # s; then it rests, and the controller's torques, which friction carries, decay
_TX40_GEARS = np.array([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
# FIGAROH's essential parameters (its examples/staubli_TX40/results/TX40_ep_5.csv, weighted least squares).
_TX40_FIGAROH = {
    "link1.Izz": 1.276673, "link2.Ixx": -0.489071, "link2.Ixz": -0.161304, "link2.Izz": 1.07001, "link2.mx": 2.173702,
    "link3.Ixx": 0.095721, "link3.Izz": 0.127811, "link3.my": -0.593324, "link3.rotor": 0.079044,
    "link4.rotor": 0.031659, "link5.my": -0.033948, "link5.rotor": 0.04708,
    "link1.viscous": 8.027866, "link2.viscous": 5.518406, "link3.viscous": 1.996059, "link4.viscous": 1.108522,
    "link5.viscous": 1.856071 - 0.60856, "link6.viscous": 0.670531 - 0.60856, "wrist.viscous": 0.60856,
    "link1.coulomb": 7.231751, "link2.coulomb": 8.253987, "link3.coulomb": 6.289599, "link4.coulomb": 2.515549,
    "link5.coulomb": 3.018672, "wrist.coulomb": 2.108124,
}  # fmt: skip


def tx40_recording(folder: Path) -> JointRecording:
    """Return the recording of Staubli's TX40: 9 s at 5 kHz, by motors that turn the joints over gears."""
    data = folder / "staubli_TX40/data"
    motor, torque = (np.loadtxt(data / f"{name}_data.csv", delimiter=",", skiprows=1) for name in ("pos_read", "curr"))
    gears = np.diag(_TX40_GEARS)
    gears[5, 4] = _TX40_GEARS[5]
    q = np.linalg.solve(gears, motor.T).T + np.array([0.0, -np.pi / 2, np.pi / 2, 0.0, 0.0, 0.0])
    return JointRecording("tx40", _TX40_PERIOD * np.arange(len(q), dtype=float), q, torque @ gears)


def tx40(folder: Path) -> Subject:
    """Staubli's TX40 (FIGAROH): motor 6 turns with joints 5 and 6, and so does its friction."""
    names = [f"link{k + 1}" for k in range(6)]
    drives = {
        name: DriveModel(row, friction(coulomb_velocity=0.03)) for name, row in zip(names, np.eye(6), strict=True)
    }
    drives["wrist"] = DriveModel(np.array([0, 0, 0, 0, 1.0, 1.0]), friction(coulomb_velocity=0.03, offset=False))
    model = TorqueRegressor(plants.tx40(), drives=drives)
    each = equations(model, tx40_recording(folder), cutoff=100.0, band=12.0)
    return Subject(
        "TX40",
        model,
        (each.between(0.0, 4.5),),
        (each.between(4.5, _TX40_END),),
        {"FIGAROH": by_parameters(model, _TX40_FIGAROH)},
        _split(each.between(0.0, _TX40_END), 2),
        block=0.1,
        published_saw_all=True,
    )


# -- TIAGo

_TIAGO_DATA = "tiago/data/identification/dynamic"
_TIAGO_GEARS = np.array([1.0, 100.0, 100.0, 100.0, 100.0, 336.0, 336.0, 336.0])
_TIAGO_MOTORS = np.array([1.0, 0.136, 0.136, -0.087, -0.087, -0.0613, -0.0613, -0.0613])


def tiago_recording(folder: Path) -> JointRecording:
    """Return the recording of PAL Robotics' TIAGo, lift and arm: 80 s at 100 Hz, positions and currents."""
    data = folder / _TIAGO_DATA
    position, effort = (
        np.loadtxt(data / f"tiago_{name}.csv", delimiter=",", skiprows=1) for name in ("position", "effort")
    )
    return JointRecording("tiago", position[:, 0], position[:, 1:], effort[:, 1:] * _TIAGO_GEARS * _TIAGO_MOTORS)


def tiago(folder: Path) -> Subject:
    """PAL Robotics' TIAGo (FIGAROH)."""
    data, model = folder / _TIAGO_DATA, TorqueRegressor(plants.tiago())
    each = equations(model, tiago_recording(folder), cutoff=4.0, band=2.0)
    fitted, held_out = (each.between(9.0, 48.0),), (each.between(48.0, 68.0),)
    published = {
        "FIGAROH": _tiago_figaroh(model, data / "tiago_bp_19_Oct_2024_2320.csv"),
        "URDF": by_parameters(model, {}, nominal=True),
    }
    return Subject(
        "TIAGo",
        model,
        fitted,
        held_out,
        {
            **{
                f"{name}, friction fitted": with_fitted_friction(model, each, fitted)
                for name, each in published.items()
            },
            **published,
        },
        _split(each.between(9.0, 68.0), 2),
        joints=(1, 2, 3, 4),
        block=0.5,
    )


def _tiago_figaroh(model: TorqueRegressor, path: Path) -> Prediction:
    """Return the torques by FIGAROH's base parameters; the first of each combination leads it, as ours."""
    values = {}
    with path.open() as file:
        for words, value, _ in csv.reader(file):
            match = re.match(r"([A-Za-z]+)(\d+)", words)
            assert match
            values[f"{plants.TIAGO_LINKS[int(match[2]) - 13]}.{match[1]}"] = float(value)
    return by_parameters(model, values)


# -- KUKA KR300

_KR300_COULOMB = 2e-4  # rad/s; friction changes as steeply as that, as its designers say, too


def kr300_recordings(folder: Path) -> list[JointRecording]:
    """Return the three movements of KUKA's KR300: 10 s at 250 Hz, torques by the motors."""
    movements = []
    for path in sorted(folder.glob("recorded_trajectories/*/data.mat")):
        content = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)
        record, gears = content["rec"], content["para"].u
        q = np.radians(record.act_pos_mot_deg.T) + np.array([0.0, -np.pi / 2, np.pi, 0.0, 0.0, 0.0])
        torques = record.act_torque_abs_nm.T * gears
        movements.append(JointRecording(path.parent.name, record.time_cont, q, torques))
    return movements


def kr300(folder: Path) -> dict[str, Subject]:
    """KUKA's KR300 R2500 (J. Weigand and others, 2021): three movements, each held out once.

    A hydraulic spring on axis 2 carries a part of the weight.
    """
    law = friction(coulomb_velocity=_KR300_COULOMB)
    drives = {f"axis{k + 1}": DriveModel(row, law) for k, row in enumerate(np.eye(6))}
    drives["spring"] = DriveModel(np.eye(6)[1], {"torque": lambda angle, rate, acceleration: kr300_spring(angle)})
    model = TorqueRegressor(plants.kr300(), drives=drives)
    movements = [equations(model, each, cutoff=20.0, band=6.0) for each in kr300_recordings(folder)]
    return {
        letter: Subject(
            f"KR300, movement {letter}",
            model,
            tuple(each for each in movements if each is not held_out),
            (held_out,),
            {"designers": kr300_published(model, folder)},
            tuple((each,) for each in movements),
        )
        for letter, held_out in zip("ABC", movements, strict=True)
    }


def kr300_spring(angle: Array) -> Array:
    """Return the torque of the designers' hydraulic spring, in N m, at the angle of axis 2."""
    far, near, diameter, rod = 0.8, 0.2, 55e-3, 30e-3
    area = np.pi * (diameter**2 - rod**2) / 4.0
    delta = angle + np.radians(95.0)
    stroke = np.sqrt(far**2 + near**2 - 2.0 * far * near * np.cos(delta)) - (far - near)
    lever = np.sin(delta) * far * near / (stroke + far - near)
    pressure = 1.01 * 296.8 * 328.0 * 2 * 0.0795 / (2 * 0.00048 - stroke * area)
    return np.asarray(lever * pressure * area)


def kr300_published(model: TorqueRegressor, folder: Path) -> Prediction:
    """Return the torques by the designers' inertias and spring, and the friction that was identified with them."""
    p = scipy.io.loadmat(folder / "data_ref.mat", squeeze_me=True, struct_as_record=False)["para"]
    motors = np.array([0.00923, 0.0118, 0.0118, 0.00173, 0.00173, 0.00173]) * p.u**2
    rotors = {f"axis{k + 1}.rotor": float(value) for k, value in enumerate(motors)}
    inertial = by_parameters(model, {"spring.torque": 1.0, **rotors}, nominal=True)

    def torques(part: RegressionEquations) -> Array:
        v = np.stack([part.Y[:, k, model.names.index(f"axis{k + 1}.viscous")] for k in range(6)], axis=1)
        return inertial(part) + p.f_asym + p.f_vis * v + p.f_coul * np.tanh(100.0 * v) + p.f_a * np.tanh(p.f_b * v)

    return torques


# -- Unitree's Go2

# Stiffness of the controller of each joint, in N m/rad.
_GO2_KP = 20.0
# Damping of the controller of each joint, in N m s/rad.
_GO2_KD = 1.5
_GO2_LEGS = ("FL", "FR", "RL", "RR")


def go2_recordings(folder: Path) -> list[JointRecording]:
    """Return the recordings of the legs of Unitree's Go2, which hangs: a chirp of 23 s at 200 Hz.

    The torques were not recorded: they follow from the drives' controllers, kp (q_d - q) - kd v.
    """
    with zipfile.ZipFile(folder / "traj_0.pt") as archive:
        times, q, desired = (
            np.frombuffer(archive.read(f"traj_0/data/{k}"), np.float32).astype(float).reshape(-1, size)
            for k, size in enumerate((1, 12, 12))
        )
    torques = _GO2_KP * (desired - q) - _GO2_KD * np.gradient(q, times[:, 0], axis=0)
    spans = [slice(3 * k, 3 * k + 3) for k in range(len(_GO2_LEGS))]
    return [
        JointRecording(leg, times[:, 0], q[:, span], torques[:, span])
        for leg, span in zip(_GO2_LEGS, spans, strict=True)
    ]


def go2(folder: Path) -> dict[str, Subject]:
    """Return the legs of Unitree's Go2 (IIT's DLS lab)."""
    legs = {}
    for recording in go2_recordings(folder):
        name = recording.source
        model = TorqueRegressor(plants.go2_leg(1.0 if name.endswith("L") else -1.0))
        each = equations(model, recording, cutoff=20.0, band=10.0)
        public = {
            f"{joint}.{term}": value
            for joint in plants.GO2_JOINTS
            for term, value in (("viscous", 0.6), ("coulomb", 0.2), ("rotor", 0.01))
        }
        legs[name] = Subject(
            f"Go2 {name}",
            model,
            (each.between(0.0, 14.0),),
            (each.between(14.0, 24.0),),
            {"public model": by_parameters(model, public, nominal=True)},
            _split(each, 3),
        )
    return legs
