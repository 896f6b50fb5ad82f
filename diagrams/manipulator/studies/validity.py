"""Count how often the arm is said to leave the validity domain of its model: in the same motions, and in others.

``python -m vtbdrake_diagrams.manipulator.studies.validity`` prints the table of docs/calibration.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import click
import numpy as np

from vtbdrake.cli.output import table
from vtbdrake.common.validity_domain import ValidityDomain
from vtbdrake.components.sensors import ErrorModel
from vtbdrake.rollout import RolloutResult, RolloutRunner, RolloutTask
from vtbdrake_diagrams.manipulator.arm import Arm
from vtbdrake_diagrams.manipulator.motions import Motion
from vtbdrake_diagrams.manipulator.scenario import ManipulatorScenario

FEATURES = ("dps.env.joint_position", "dps.env.joint_velocity", "dps.joint_torque")
"""The features of a state of the arm, for the validity domain of its model."""

# Duration of a window of the domain, in s.
WINDOW = 0.1
# Duration of a motion, in s.
HORIZON = 8.0
# Shares of the calibration's windows that the domain holds.
QUANTILES = (0.95, 1.0)
# Amplitude of the motion of each joint, in rad.
_SWING = np.array([0.6, 0.3, -0.4, 0.4, 0.5, -0.3, 0.6])

# What differs from the recorded motions: factors of speed and amplitude, the tool's mass in kg, the home pose in rad.
CASES: Mapping[str, Mapping[str, Any]] = {
    "the same motions": {},
    "1.5 times as fast": {"speed": 1.5},
    "twice as fast": {"speed": 2.0},
    "0.1 kg more payload": {"mass": Arm().tool_mass + 0.1},
    "0.4 kg more payload": {"mass": Arm().tool_mass + 0.4},
    "another pose (0.2 rad)": {"offset": 0.2},
    "1.5 times as far": {"size": 1.5},
}


class Motions:
    """Draws motions of the arm with noisy sensors, circles and swings with random durations and amplitudes."""

    def __init__(self, seed: int) -> None:
        scenario = ManipulatorScenario(
            law="joint_impedance",
            position_errors=ErrorModel(noise=1e-5),
            velocity_errors=ErrorModel(noise=1e-3),
        )
        task = RolloutTask(scenario=scenario, horizon=HORIZON, sample_period=WINDOW, record=FEATURES)
        self._runner = RolloutRunner(task)
        self._random = np.random.default_rng(seed)

    def draw(
        self, *, speed: float = 1.0, size: float = 1.0, mass: float = Arm().tool_mass, offset: float = 0.0
    ) -> RolloutResult:
        """Return the recording of one motion."""
        uniform = self._random.uniform
        free = self._random.choice([Motion.SWING, Motion.CIRCLE])
        motion = Motion.HOME if offset else Motion.SWING if size > 1.0 else free
        values: dict[str, Any] = {
            "u.motion": float(motion),
            "dps.impl.swing": size * uniform(0.8, 1.0, 7) * _SWING,
            "dps.impl.swing_duration": uniform(4.0, 5.0) / speed,
            "dps.impl.circle_radius": size * uniform(0.08, 0.1),
            "dps.impl.circle_duration": uniform(3.5, 4.5) / speed,
            "sim.sys.arm.tool.mass": mass,
        }
        if offset:
            values["dps.impl.home"] = np.array(Arm().home) + offset
        return self._runner.run(values)


class Shares(NamedTuple):
    """Shares of windows outside a domain, and of recordings that are said to leave it.

    Attributes:
        outside: Share of the windows.
        departures: Share of the recordings.
        feature: The one that was named most often.
    """

    outside: float
    departures: float
    feature: str


def shares(
    same: list[RolloutResult], recordings: list[RolloutResult], *, quantile: float, draws: int = 20, seed: int = 0
) -> Shares:
    """Return the shares over random halves of the recordings of the same motions, each beside all ``recordings``.

    Recordings of the same motions that made the domain are left out.
    """
    random = np.random.default_rng(seed)
    outside, departures = [], []
    for _ in range(draws):
        half = [same[k] for k in random.permutation(len(same))[: len(same) // 2]]
        domain = ValidityDomain.of(half, FEATURES, window=WINDOW, quantile=quantile)
        for recording in (each for each in recordings if id(each) not in map(id, half)):
            states = np.hstack([recording.record[address] for address in FEATURES])
            outside.append(np.mean([domain.factor(x) > 1.0 for x in states]))
            departures.append(domain.departure(recording))
    features = [departure.feature for departure in departures if departure is not None]
    named = max(set(features), key=features.count) if features else ""
    return Shares(float(np.mean(outside)), len(features) / len(departures), named)


@click.command()
@click.option("--runs", default=20, show_default=True, help="Recordings of the same motions.")
def main(runs: int) -> None:
    """Print the shares of windows and recordings outside."""
    motions = Motions(seed=0)
    counts = {name: runs // 2 if case else runs for name, case in CASES.items()}
    recordings = {name: [motions.draw(**case) for _ in range(counts[name])] for name, case in CASES.items()}
    same = recordings["the same motions"]
    for quantile in QUANTILES:
        rows = []
        for name, some in recordings.items():
            result = shares(same, some, quantile=quantile)
            rows.append((name, f"{result.outside:.1%}", f"{result.departures:.1%}", result.feature))
        print(
            table((f"quantile {quantile:g}", "windows outside", "recordings that leave it", "mostly by"), rows) + "\n"
        )


if __name__ == "__main__":
    main()
