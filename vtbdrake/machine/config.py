"""What a machine is told."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from typing import Any

HOLD, IDLE, LOCK = "hold", "idle", "lock"
BRAKES = (HOLD, IDLE, LOCK)


@dataclass(frozen=True, kw_only=True)
class MachineConfig:
    """How a machine differs from the simulated world, and how it behaves.

    Raises:
        ValueError: a value is out of its range.
    """

    period: float = 1e-3  # s, of a cycle
    values: Mapping[str, Any] = field(default_factory=dict)  # variables of the world to set, by address
    perturb: float = 0.0  # largest relative change, see `perturbed_values`; `values` are set afterwards
    noise: Mapping[str, float] = field(default_factory=dict)  # vector sensor signal -> standard deviation, in its unit
    seed: int = 0  # of perturbation, noise and faults
    sense_delay: float = 0.0  # s that messages to the controller take, in whole cycles, rounded up
    act_delay: float = 0.0  # s that messages from the controller take
    timeout: float = 0.1  # s without a command after which the machine brakes
    max_delay: float = 0.1  # s that a command may take longer than the quickest, by its sender's clock
    brake: str = ""  # hold, idle or lock (see `HoldingBrake`); empty: lock if the plant is discrete, else idle
    control_channel: str = "VTB_MACHINE"  # where it listens to requests
    status_channel: str = "VTB_MACHINE_STATUS"  # where it says how it is
    status_period: float = 0.1  # s

    def __post_init__(self) -> None:
        for name in ("period", "timeout", "status_period"):
            if not 0.0 < getattr(self, name) < inf:
                raise ValueError(f"{name} of a machine is a positive time in seconds, not {getattr(self, name)!r}")
        if not self.max_delay > 0.0:
            raise ValueError(f"max_delay of a machine is positive, or inf where none is late, not {self.max_delay!r}")
        for name in ("sense_delay", "act_delay"):
            if not 0.0 <= getattr(self, name) < inf:
                raise ValueError(f"{name} of a machine is a time of at least 0 s, not {getattr(self, name)!r}")
        if not 0.0 <= self.perturb < 1.0:
            raise ValueError(f"perturb is a relative change from 0 to below 1, not {self.perturb!r}")
        if self.seed < 0:
            raise ValueError(f"a seed is a whole number from 0 on, not {self.seed!r}")
        if self.brake and self.brake not in BRAKES:
            raise ValueError(f"brake is one of {', '.join(BRAKES)}, not {self.brake!r}")
        for name, deviation in self.noise.items():
            if not 0.0 <= deviation < inf:
                raise ValueError(f"the noise of {name} is a standard deviation from 0 on, not {deviation!r}")
