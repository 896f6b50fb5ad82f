"""Grips that end captures: when the fingers hold the bar, and how far it then is from where it is perceived.

Several applications compare what guides a capture by these two.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import vtbdrake as vtb
from vtbdrake.common.arrays import Array
from vtbdrake.rollout import RolloutRunner, RolloutTask
from vtbdrake.state.systems import pose_from_array
from vtbdrake_diagrams.satellite.bodies import Target
from vtbdrake_diagrams.satellite.relative_motion import Relative
from vtbdrake_diagrams.satellite.scenario import SatelliteScenario
from vtbdrake_diagrams.satellite.supervisor import Mode

FAILURE = 60.0
"""The time that counts for a capture without success, in s."""
SAMPLE_PERIOD = 0.2
"""Sample period of the costs, in s."""
MODE = "dps.impl.supervisor.mode"
"""The address of the supervisor's mode."""
TIME = "dps.env.base.time"
"""The address of the time of the DPS, in s."""
RECORDED = ("sim.sys.servicer.base.pose", "sim.sys.target.body.pose", "dps.impl.relative.relative")
"""The arguments of `bar_error`: the true poses, and a `Relative`."""


def time_to_grip(mode: float, time: float) -> float:
    """Return the time of the DPS if the fingers hold the bar, else `FAILURE`."""
    return time if mode in (Mode.RETREAT, Mode.HOLD) else FAILURE


def bar_error(base: Array, target: Array, relative: Array) -> float:
    """Return how far the bar is from where the DPS believes it, seen from the base, in m.

    Args:
        base: The pose of the base in the world, [x, y, z, roll, pitch, yaw] in m and rad.
        target: The pose of the target, likewise.
        relative: A `Relative` as a vector.
    """
    X_BT = pose_from_array(base).InvertAndCompose(pose_from_array(target))
    return float(np.linalg.norm(X_BT @ Target().X_TH.translation() - Relative(relative).p_BH))


def guided_grips(
    scenario: SatelliteScenario, starts: Sequence[Mapping[str, Any]], *, horizon: float
) -> tuple[Array, Array]:
    """Simulate captures from some starts.

    Args:
        scenario: The satellite, with what guides it.
        starts: The values of the starts by address.
        horizon: How long a capture may take, in s.

    Returns:
        When the fingers held the bar, in s, `FAILURE` if they never did, and how far the bar was from where the DPS
        believed it then, in m, NaN without success; both of shape (starts,).
    """
    task = RolloutTask(
        scenario=scenario,
        horizon=horizon,
        quality=vtb.Quality(time_to_grip, of=[MODE, TIME], minimize=True),
        threshold=FAILURE,
        sample_period=SAMPLE_PERIOD,
        record=RECORDED,
    )
    runner = RolloutRunner(task, scenario.build())
    rollouts = [runner.run(start) for start in starts]
    times = [FAILURE if rollout.failed else rollout.value for rollout in rollouts]
    errors = [
        bar_error(*(r.record[a][-1] for a in RECORDED)) if t < FAILURE else np.nan
        for r, t in zip(rollouts, times, strict=True)
    ]
    return np.array(times), np.array(errors)
