"""What an actuator signal gets when the DPS cannot be relied on."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vtbdrake.testbed import Interface, Signal


class Sample(NamedTuple):
    """The newest sample of a sensor signal that was accepted as plausible.

    Attributes:
        value: of the signal; an array of shape (size,), or an abstract value.
        age: seconds since it arrived.
    """

    value: Any
    age: float


class NoCommand:
    """The type of `NO_COMMAND`."""

    def __repr__(self) -> str:
        return "NO_COMMAND"


NO_COMMAND: Final = NoCommand()
"""What a fallback returns to have nothing sent: the machine's own time-out then brakes it."""


class Fallback(ABC):
    """Commands one actuator signal from a fault on, until the guards are reset; its commands are limited like all.

    Attributes:
        otherwise: takes over for the cycle if this one raises or commands what cannot be sent; the last command stays
            if that is None, or fails too.
    """

    otherwise: Fallback | None = None

    def check(self, signal: Signal, *, interface: Interface) -> None:  # noqa: B027 - most can command anything
        """
        Raises:
            ValueError: it cannot command ``signal``.
        """

    def take_over(self) -> None:  # noqa: B027 - most remember nothing
        """Called before its first command after a fault: what it remembers of an earlier one is long over."""

    @abstractmethod
    def command(self, last_sent: Any, sensed: Mapping[str, Any], known: Mapping[str, Sample], dt: float) -> Any:
        """Return what is to be sent, or `NO_COMMAND`.

        Args:
            last_sent: what was sent last, shape (size,).
            sensed: values of the sensor signals that are fresh and plausible at present. The signal that caused the
                fault is usually not in it.
            known: the newest sample of every sensor signal that was accepted, however old it is. A signal of which no
                sample was ever accepted is not in it.
            dt: seconds since the cycle before.
        """


class Hold(Fallback):
    """The last command stays, or what comes closest to it within the limits: a commanded position comes to rest, as
    quickly as the limit of acceleration allows."""

    def command(self, last_sent: Any, sensed: Mapping[str, Any], known: Mapping[str, Sample], dt: float) -> Any:
        return last_sent


class Zero(Fallback):
    """No torque, no force, no speed; along the limits."""

    def check(self, signal: Signal, *, interface: Interface) -> None:
        if not signal.is_vector:
            raise ValueError(f"the actuator signal {signal.name} is abstract, it has no zero: take another fallback")

    def command(self, last_sent: Any, sensed: Mapping[str, Any], known: Mapping[str, Sample], dt: float) -> Any:
        return np.zeros(len(last_sent))


class Silence(Fallback):
    """Sends nothing, so that the machine's own time-out brakes it: for machines that have one."""

    def command(self, last_sent: Any, sensed: Mapping[str, Any], known: Mapping[str, Sample], dt: float) -> Any:
        return NO_COMMAND


class Brake(Fallback):
    """Brakes by torques or forces against the measured velocity v: -gain v.

    Without a fresh velocity it is `Zero`: a torque that is held blindly accelerates. (A commanded position is braked by
    `Hold`, a commanded velocity by `Zero`.)

    Args:
        velocity: the sensor signal that holds v.
        gain: viscous damping, in the actuator signal's unit by the sensor's; a scalar or one per entry of v. In a loop
            of period T it is stable for gain T < 2 * inertia, less what delay takes.
        entries: where v lies in the sensor signal; all of it by default.
    """

    otherwise = Zero()

    def __init__(self, velocity: str, *, gain: ArrayLike, entries: slice = slice(None)) -> None:
        self.velocity = velocity
        self.gain = np.array(gain, dtype=float)
        if not (self.gain >= 0.0).all():
            raise ValueError(f"a brake has gains from 0 on; {self.gain.tolist()} would accelerate")
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
    """A controller of the user's own.

    Args:
        function: gets the arguments of `Fallback.command`, returns the command.
        otherwise: takes over for the cycle if it raises or returns what cannot be sent.
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
    """`Hold` for positions (rad, m); `Zero` for velocities, torques and forces, currents and voltages.

    Raises:
        ValueError: the unit does not tell what is safe.
    """
    if signal.unit not in _BY_UNIT:
        raise ValueError(
            f"the unit {signal.unit!r} of actuator signal {signal.name} does not tell what is safe after a fault "
            f"(units that do: {', '.join(_BY_UNIT)}): give the guards fallback={{{signal.name!r}: Hold()}}, Zero(), "
            "or Brake(...)"
        )
    return _BY_UNIT[signal.unit]()


def chain(fallback: Fallback, signal: Signal, *, interface: Interface) -> list[Fallback]:
    """``fallback``, what takes over if it fails, and so on.

    Raises:
        ValueError: one of them cannot command ``signal``.
    """
    found: list[Fallback] = []
    link: Fallback | None = fallback
    while link is not None and link not in found:
        link.check(signal, interface=interface)
        found.append(link)
        link = link.otherwise
    return found
