"""Fallbacks: sources of actuator commands after a fault."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vtbdrake.testbed import Interface, Signal

if TYPE_CHECKING:
    from pydrake.multibody.plant import MultibodyPlant


class Sample(NamedTuple):
    """The newest plausible sample of a sensor signal.

    Attributes:
        value: An array of shape (size,), or an abstract value.
        age: Time since it arrived, in seconds.
    """

    value: Any
    age: float


class NoCommand:
    """The type of `NO_COMMAND`."""

    def __repr__(self) -> str:
        return "NO_COMMAND"


NO_COMMAND: Final = NoCommand()
"""Returned by a fallback that wants nothing sent, so that the machine's own time-out brakes it."""


class Fallback(ABC):
    """Commands one actuator signal from a fault on, until the guards are reset; its commands are limited like all.

    Attributes:
        otherwise: The fallback for a cycle in which this one raises or returns an invalid command. If it is None or
            fails, too, the last command stays.
    """

    otherwise: Fallback | None = None

    def check_signal(self, signal: Signal, *, interface: Interface) -> None:  # noqa: B027 - most can command anything
        """Check that this fallback can command a signal.

        Args:
            signal: The actuator signal.
            interface: All signals of the DPS, such as the sensor signals that the fallback reads.

        Raises:
            ValueError: It cannot.
        """

    def begin(self) -> None:  # noqa: B027 - most remember nothing
        """Forget earlier faults; called before the first command after a fault."""

    @abstractmethod
    def command(self, last_sent: Any, sensed: Mapping[str, Any], samples: Mapping[str, Sample], dt: float) -> Any:
        """Return the command to be sent, shape (size,), or `NO_COMMAND`.

        Args:
            last_sent: The last sent command, shape (size,).
            sensed: Values of the sensor signals that are fresh and plausible at present. Usually the signal that caused
                the fault is missing.
            samples: The newest accepted sample of every sensor signal, however old. Signals without any accepted sample
                are missing.
            dt: Time since the cycle before, in seconds.
        """


class Hold(Fallback):
    """Repeats the last command within the limits: a commanded position comes to rest as quickly as they allow.

    Only for positions: a torque or a force that is held accelerates, and a velocity that is held goes on.
    """

    def command(self, last_sent: Any, sensed: Mapping[str, Any], samples: Mapping[str, Sample], dt: float) -> Any:
        return last_sent


class Zero(Fallback):
    """Commands zero torque, force or velocity, approached within the limits.

    Zero torque is safe for an arm that carries its own weight. Another one falls, and its time-out does not brake it,
    as commands go on: take `Silence` or `CarryWeight`.
    """

    def check_signal(self, signal: Signal, *, interface: Interface) -> None:
        if not signal.is_vector:
            raise ValueError(f"the actuator signal {signal.name} is abstract, it has no zero: take another fallback")

    def command(self, last_sent: Any, sensed: Mapping[str, Any], samples: Mapping[str, Sample], dt: float) -> Any:
        return np.zeros(len(last_sent))


class Silence(Fallback):
    """Sends nothing, so that the machine's own time-out brakes it. Only for machines that have one."""

    def command(self, last_sent: Any, sensed: Mapping[str, Any], samples: Mapping[str, Sample], dt: float) -> Any:
        return NO_COMMAND


class Brake(Fallback):
    """Brakes by torques or forces against the measured velocity v: -gain v.

    Without a fresh velocity, `Zero` takes over: a torque that is held blindly accelerates. (For commanded positions use
    `Hold`, for commanded velocities `Zero`.)

    Args:
        velocity: Name of the sensor signal that contains v.
        gain: Viscous damping, in the actuator signal's unit by the sensor's; a scalar or one per entry of v. In a loop
            of period T it is stable for gain T < 2 * inertia; delay reduces this bound.
        entries: The entries of the sensor signal that are v; by default all.

    Raises:
        ValueError: A gain is negative.
    """

    otherwise = Zero()

    def __init__(self, velocity: str, *, gain: ArrayLike, entries: slice = slice(None)) -> None:
        self.velocity = velocity
        self.gain = np.array(gain, dtype=float)
        if not (self.gain >= 0.0).all():
            raise ValueError(f"the gains of a brake are not negative, unlike {self.gain.tolist()}")
        self.entries = entries

    def check_signal(self, signal: Signal, *, interface: Interface) -> None:
        sizes = {sensor.name: sensor.size for sensor in interface.sense if sensor.size is not None}
        if self.velocity not in sizes:
            raise ValueError(f"the brake of {signal.name} needs a vector sensor signal, not {self.velocity!r}")
        velocity = np.zeros(sizes[self.velocity])[self.entries]
        if self.gain.shape not in ((), velocity.shape) or velocity.shape != (signal.size,):
            raise ValueError(
                f"the brake of {signal.name}, of size {signal.size}, gets {velocity.size} velocities from "
                f"{self.velocity} and gains of shape {self.gain.shape}: they must agree"
            )

    def command(self, last_sent: Any, sensed: Mapping[str, Any], samples: Mapping[str, Sample], dt: float) -> Any:
        if self.velocity not in sensed:
            return self.otherwise.command(last_sent, sensed, samples, dt)
        return -self.gain * sensed[self.velocity][self.entries]


def gravity_compensation(plant: MultibodyPlant) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Return the generalized forces that carry the weight of a plant, -tau_g(q), as a function of its positions q.

    The function keeps a context of its own: one thread may call it at a time.

    Args:
        plant: The finalized plant of the arm and its tool alone, its base welded to the world.
    """
    context = plant.CreateDefaultContext()

    def torques(q: NDArray[np.float64]) -> NDArray[np.float64]:
        plant.SetPositions(context, q)
        return np.asarray(-plant.CalcGravityGeneralizedForces(context))

    return torques


class CarryWeight(Fallback):
    """Carries the weight of an arm by the torques u of its actuators, with B u = -tau_g(q), so that it floats in place.

    B is the actuation matrix of a plant, and tau_g(q) its generalized forces of gravity at the measured positions q. A
    `Brake` adds its torques while its velocity is fresh; without one, nothing stops an arm that moves. Torques are in
    the order of the plant's actuators.

    Without a fresh position the weight at the last accepted one is carried, until that sample is ``longest`` old. Then,
    or if no position was ever accepted, nothing is sent (`Silence`): what is unknown cannot be carried.

    Args:
        plant: The finalized plant of the arm and its tool alone, as the DPS models it. Every joint has an actuator.
        position: Name of the sensor signal that contains q, in the plant's order.
        entries: The entries of that signal that are q; by default all.
        brake: Damps the motion.
        longest: Seconds for which the weight is carried at the last accepted position.

    Raises:
        ValueError: Some joints of the plant have no actuator.
    """

    otherwise = Silence()

    def __init__(
        self,
        plant: MultibodyPlant,
        position: str,
        *,
        entries: slice = slice(None),
        brake: Brake | None = None,
        longest: float = 0.2,
    ) -> None:
        self.position, self.entries, self.brake, self.longest = position, entries, brake, longest
        actuation = plant.MakeActuationMatrix()
        size = plant.num_positions()
        if actuation.shape != (size, size) or np.linalg.matrix_rank(actuation) < size:
            raise ValueError(
                f"a plant with {size} positions and {plant.num_actuators()} actuators cannot be carried: it needs one "
                "actuator per position, so weld its base and leave out what is not actuated"
            )
        self._size, self._gravity_compensation = size, gravity_compensation(plant)
        self._to_actuators = np.linalg.inv(actuation)

    def check_signal(self, signal: Signal, *, interface: Interface) -> None:
        sizes = {sensor.name: sensor.size for sensor in interface.sense if sensor.size is not None}
        position_count = len(range(sizes.get(self.position, 0))[self.entries])
        if not position_count == self._size == signal.size:
            raise ValueError(
                f"the weight of a plant with {self._size} positions is carried by as many torques and measured "
                f"positions, not by the {signal.size} entries of {signal.name} with {position_count} entries of "
                f"{self.position!r}"
            )
        if self.brake is not None:
            self.brake.check_signal(signal, interface=interface)

    def command(self, last_sent: Any, sensed: Mapping[str, Any], samples: Mapping[str, Sample], dt: float) -> Any:
        last = samples.get(self.position)
        if last is None or (self.position not in sensed and last.age > self.longest):
            return NO_COMMAND
        torques = self._to_actuators @ self._gravity_compensation(last.value[self.entries])
        if self.brake is not None and self.brake.velocity in sensed:
            torques += self.brake.command(last_sent, sensed, samples, dt)
        return torques


class FallbackController(Fallback):
    """Calls a function of the user.

    Args:
        function: Gets the arguments of `Fallback.command` and returns the command.
        otherwise: The fallback for a cycle in which the function raises or returns an invalid command.
    """

    def __init__(
        self, function: Callable[[Any, Mapping[str, Any], Mapping[str, Sample], float], Any], *, otherwise: Fallback
    ) -> None:
        self.function = function
        self.otherwise = otherwise

    def command(self, last_sent: Any, sensed: Mapping[str, Any], samples: Mapping[str, Sample], dt: float) -> Any:
        return self.function(last_sent, sensed, samples, dt)


_POSITIONS = ("rad", "m")
_BY_UNIT: dict[str, type[Fallback]] = {
    **dict.fromkeys(_POSITIONS, Hold),
    **dict.fromkeys(("rad/s", "m/s", "N", "N m", "A", "V"), Zero),
}


def is_position(signal: Signal) -> bool:
    """Return whether the unit of a signal is a unit of positions (rad, m, or both)."""
    return all(unit in _POSITIONS for unit in signal.unit.split(", "))


def default_fallback(signal: Signal) -> Fallback:
    """Return `Hold` for positions (rad, m), `Zero` for velocities, torques, forces, currents and voltages.

    Raises:
        ValueError: The signal's unit is none of these.
    """
    if signal.unit not in _BY_UNIT:
        raise ValueError(
            f"the unit {signal.unit!r} of actuator signal {signal.name} does not tell what is safe after a fault "
            f"(units that do: {', '.join(_BY_UNIT)}): give the guards fallback={{{signal.name!r}: Hold()}}, Zero(), "
            "or Brake(...)"
        )
    return _BY_UNIT[signal.unit]()


def chain(fallback: Fallback, signal: Signal, *, interface: Interface) -> list[Fallback]:
    """Return a fallback, the one that replaces it if it fails, and so on.

    Args:
        fallback: The first fallback.
        signal: The actuator signal that it commands.
        interface: All signals of the DPS, such as the sensor signals that a fallback reads.

    Raises:
        ValueError: One of them is no fallback, or cannot command ``signal``.
    """
    links: list[Fallback] = []
    link: Fallback | None = fallback
    while link is not None and link not in links:
        if not isinstance(link, Fallback):
            raise ValueError(f"the fallback of {signal.name} is a Fallback, Zero() say, not {link!r}")
        link.check_signal(signal, interface=interface)
        links.append(link)
        link = link.otherwise
    return links
