"""A driven pendulum that is not made of the package's parts: small steps, friction that sticks, of several laws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.calibration.pendulum import PERIOD
from vtbdrake.recording import Log, read_table

MASS = 1.0  # kg
CENTER = 0.36  # m
MOMENT = 0.03  # kg m^2
COULOMB = 0.2  # N m
VISCOUS = 0.03  # N m s/rad
GRAVITY = 9.81  # m/s^2
# (velocity in rad/s, torque in N m) -> the size of the friction beside the viscous one, in N m.
Law = Callable[[float, float], float]

# Dahl's friction has a memory: it rises over about this angle after each turn of the motion, in rad.
DAHL_ANGLE = 0.1

LAWS: dict[str, Law] = {
    "Coulomb": lambda v, torque: COULOMB,
    "Stribeck": lambda v, torque: COULOMB * (1.0 + 0.8 * np.exp(-((v / 0.3) ** 2))),
    "tolerance": lambda v, torque: COULOMB * (1.0 + 0.1 * np.exp(-((v / 0.3) ** 2))),
    "direction": lambda v, torque: COULOMB * (1.3 if v > 0.0 else 0.7),
    "load": lambda v, torque: 0.5 * COULOMB + 0.1 * abs(torque),
    "Dahl": lambda v, torque: 0.0,
}


def commanded(rng: np.random.Generator, times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return torques that move the pendulum: four waves."""
    waves = [
        rng.uniform(0.5, 1.5) * np.sin(2.0 * np.pi * rng.uniform(0.1, 2.0) * times + rng.uniform(0.0, 6.0))
        for _ in range(4)
    ]
    return np.sum(waves, axis=0) * (1.0 - np.exp(-times / 0.1))


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion of the pendulum.

    Attributes:
        times: (n,), in s.
        torques: The commanded torques, (n,), in N m.
        positions: The true angles, (n,), in rad.
        velocities: Their rates, (n,), in rad/s.
        rng: The generator after the motion was drawn.
    """

    times: NDArray[np.float64]
    torques: NDArray[np.float64]
    positions: NDArray[np.float64]
    velocities: NDArray[np.float64]
    rng: np.random.Generator

    def log(self, *, offset: float = 0.0) -> Log:
        """Return the log of the motion, with noise of 0.2 mrad.

        Args:
            offset: What the encoder shows at zero, in rad.
        """
        measured = self.positions + offset + 2e-4 * self.rng.normal(size=self.times.size)
        columns = {"time": self.times, "q": measured, "u": self.torques}
        return read_table(columns, sense={"position": "q"}, act={"torque": "u"})


def recorded(law: str = "Coulomb", *, seed: int, offset: float = 0.0, **options: float) -> Log:
    """Return a log of the pendulum, with noise of 0.2 mrad.

    Args:
        law: As in `moved`.
        seed: Seed of motion and noise.
        offset: What the encoder shows at zero, in rad.
        **options: Further arguments of `moved`.
    """
    return moved(law, seed=seed, **options).log(offset=offset)


def moved(
    law: str = "Coulomb",
    *,
    seed: int,
    disturbance: float = 0.0,
    seconds: float = 8.0,
    center: float = CENTER,
    moment: float = MOMENT,
    coulomb: float = 0.0,
    amplitude: float = 1.0,
    step: float = 4e-4,
) -> Motion:
    """Return a motion of the pendulum.

    Each step takes the friction implicitly: it never turns the velocity around. Dahl's friction f (P. Dahl, "A solid
    friction model", Aerospace Corporation TOR-0158, 1968) is a spring that gives way: with the angle a, and F its
    limit, df/dt = (F v - f |v|) / a.

    Args:
        law: Name of the friction's law.
        seed: Seed of motion and noise.
        disturbance: Deviation of a torque that is not in the log, in N m; it is correlated over 50 ms.
        seconds: Duration.
        center: Distance of the centre of mass from the joint, in m.
        moment: Moment of inertia about the centre of mass, in kg m^2.
        coulomb: Friction beside the law's, in N m.
        amplitude: Factor of the torques.
        step: Step of the simulation, in s.
    """
    rng = np.random.default_rng(seed)
    times = PERIOD * np.arange(round(seconds / PERIOD))
    torques = amplitude * commanded(rng, times)
    decay, walk = np.exp(-PERIOD / 0.05), np.zeros(times.size)
    for k in range(1, times.size):
        walk[k] = decay * walk[k - 1] + np.sqrt(1.0 - decay**2) * rng.normal()
    acting = torques + disturbance * walk
    inertia = moment + MASS * center**2
    q = v = bristle = 0.0
    states = []
    for k in range(times.size):
        states.append((q, v))
        torque = acting[k - 1] if k else 0.0  # A command acts a period later, as with the testbed's drives.
        for _ in range(round(PERIOD / step)):
            held = torque - VISCOUS * v - MASS * GRAVITY * center * np.sin(q) - bristle
            free = v + step * held / inertia
            friction = coulomb + LAWS[law](v, torque)
            v = np.sign(free) * max(abs(free) - step * friction / inertia, 0.0)
            q += step * v
            if law == "Dahl":
                bristle += step * (v * COULOMB - abs(v) * bristle) / DAHL_ANGLE
    positions, velocities = np.array(states).T
    return Motion(times, torques, positions, velocities, rng)
