"""The configuration of a machine, without Drake: the command line makes options of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vtbdrake.common.settings import check_settings, setting

HOLD = "hold"
IDLE = "idle"
LOCK = "lock"
BRAKES = (HOLD, IDLE, LOCK)


@dataclass(frozen=True, kw_only=True)
class MachineConfig:
    """Configuration of a machine: its differences from the simulated world, and its behaviour.

    Raises:
        ValueError: A value is out of its range.
    """

    period: float | None = setting(
        None,
        "The period of a cycle, which publishes the state once; by default the deployment's period.",
        unit="s",
        gt=0.0,
    )
    values: Mapping[str, Any] = setting(
        default_factory=dict, doc="Variables of the world to set, by address, after the perturbation."
    )
    perturb: float = setting(
        0.0,
        "Multiply masses, damping, friction and rotor inertias by random factors from 1 - R to 1 + R.",
        ge=0.0,
        lt=1.0,
    )
    noise: Mapping[str, float] = setting(
        default_factory=dict, doc="Vector sensor signal -> standard deviation of its normal noise, in its unit.", ge=0.0
    )
    disturbance: Mapping[str, float] = setting(
        default_factory=dict,
        doc="Vector actuator signal -> standard deviation of a disturbance that is added to what acts, in its unit. "
        "It changes with the time constant `disturbance_time`, and no message contains it.",
        ge=0.0,
    )
    disturbance_time: float = setting(0.05, "The correlation time of the disturbances.", unit="s", gt=0.0)
    seed: int = setting(0, "The seed of perturbation, noise, disturbances and faults.", ge=0)
    sense_latency: float = setting(
        0.0, "The latency of messages to the controller, rounded up to whole cycles.", unit="s", ge=0.0
    )
    act_latency: float = setting(
        0.0, "The latency of messages from the controller, rounded up to whole cycles.", unit="s", ge=0.0
    )
    timeout: float = setting(0.1, "Time without an actuator command after which the machine brakes.", unit="s", gt=0.0)
    max_latency: float = setting(
        0.1,
        "Reject commands that took so much longer than the quickest one, by their sender's clock; inf rejects none. "
        "Not in lock-step.",
        unit="s",
        gt=0.0,
        finite=False,
    )
    brake: str = setting(
        "",
        "Lock the joints (default for a discrete plant), apply the idle commands (default for a continuous one) or "
        "hold the last commands.",
        choices=("", *BRAKES),
    )
    control_channel: str = setting("VTB_MACHINE", "The LCM channel of requests.")
    status_channel: str = setting("VTB_MACHINE_STATUS", "The LCM channel of the status.")
    status_period: float = setting(0.1, "The time between messages of the status.", unit="s", gt=0.0)

    def __post_init__(self) -> None:
        check_settings(self)

    def check_lock_step(self) -> None:
        """Check that a machine with this configuration can run in lock-step.

        Raises:
            ValueError: It would hold back a state, and wait for the command that answers it.
        """
        if self.sense_latency:
            raise ValueError(
                f"in lock-step a machine has no sense_latency, unlike {self.sense_latency} s: it would hold back the "
                "state that the command it waits for answers; give the latency to the sensors of the scenario "
                "(ErrorModel(latency=...)), or let the clock begin the cycles"
            )
