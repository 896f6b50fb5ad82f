"""Fallbacks: sources of actuator commands after a fault."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.testbed import Interface, Signal


class Sample(NamedTuple):
    """The newest plausible sample of a sensor signal."""

    value: Any  # an array of shape (size,), or an abstract value
    age: float  # time since it arrived, in seconds


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

    def check(self, signal: Signal, *, interface: Interface) -> None:  # noqa: B027 - most can command anything
        """Check that this fallback can command a signal.

        Raises:
            ValueError: It cannot.
        """

    def begin(self) -> None:  # noqa: B027 - most remember nothing
        """Forget earlier faults; called before the first command after a fault."""

    @abstractmethod
    def command(self, last_sent: Any, sensed: Mapping[str, Any], known: Mapping[str, Sample], dt: float) -> Any:
        """Return the command to be sent, shape (size,), or `NO_COMMAND`.

        Args:
            last_sent: The last sent command, shape (size,).
            sensed: Values of the sensor signals that are fresh and plausible at present. Usually the signal that caused
                the fault is missing.
            known: The newest accepted sample of every sensor signal, however old. Signals of which no sample was ever
                accepted are missing.
            dt: Time since the cycle before, in seconds.
        """


class Hold(Fallback):
    """Repeats the last command within the limits: a commanded position comes to rest as quickly as they allow.

    Only for positions: a torque or a force that is held accelerates, and a velocity that is held goes on.
    """

    def command(self, last_sent: Any, sensed: Mapping[str, Any], known: Mapping[str, Sample], dt: float) -> Any:
        return last_sent


class Zero(Fallback):
    """Commands zero torque, force or velocity, approached within the limits.

    Zero torque is safe for an arm that carries its own weight. Another one falls, and its time-out does not brake it,
    as commands go on: take `Silence`, or a `FallbackController` with a model.
    """

    def check(self, signal: Signal, *, interface: Interface) -> None:
        if not signal.is_vector:
            raise ValueError(f"the actuator signal {signal.name} is abstract, it has no zero: take another fallback")

    def command(self, last_sent: Any, sensed: Mapping[str, Any], known: Mapping[str, Sample], dt: float) -> Any:
        return np.zeros(len(last_sent))


class Silence(Fallback):
    """Sends nothing, so that the machine's own time-out brakes it. Only for machines that have one."""

    def command(self, last_sent: Any, sensed: Mapping[str, Any], known: Mapping[str, Sample], dt: float) -> Any:
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

    def check(self, signal: Signal, *, interface: Interface) -> None:
        sizes = {sensor.name: sensor.size for sensor in interface.sense if sensor.size is not None}
        if self.velocity not in sizes:
            raise ValueError(f"the brake of {signal.name} needs a vector sensor signal, not {self.velocity!r}")
        velocity = np.zeros(sizes[self.velocity])[self.entries]
        if self.gain.shape not in ((), velocity.shape) or velocity.shape != (signal.size,):
            raise ValueError(
                f"the brake of {signal.name}, of size {signal.size}, gets {velocity.size} velocities from "
                f"{self.velocity} and gains of shape {self.gain.shape}: they must agree"
            )

    def command(self, last_sent: Any, sensed: Mapping[str, Any], known: Mapping[str, Sample], dt: float) -> Any:
        return -self.gain * sensed[self.velocity][self.entries]


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

    def command(self, last_sent: Any, sensed: Mapping[str, Any], known: Mapping[str, Sample], dt: float) -> Any:
        return self.function(last_sent, sensed, known, dt)


_BY_UNIT: dict[str, type[Fallback]] = {
    **dict.fromkeys(("rad", "m"), Hold),
    **dict.fromkeys(("rad/s", "m/s", "N", "N m", "A", "V"), Zero),
}


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

    Raises:
        ValueError: One of them is no fallback, or cannot command ``signal``.
    """
    found: list[Fallback] = []
    link: Fallback | None = fallback
    while link is not None and link not in found:
        if not isinstance(link, Fallback):
            raise ValueError(f"the fallback of {signal.name} is a Fallback, Zero() say, not {link!r}")
        link.check(signal, interface=interface)
        found.append(link)
        link = link.otherwise
    return found
