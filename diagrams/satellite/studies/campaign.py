"""A campaign of captures from random starts: how often they succeed, and why they fail.

``python -m vtbdrake_diagrams.satellite.studies.campaign [--captures N] [--perception P] [--wheels] [--workers W]
[--seed S]`` simulates captures from random starts (`random_start`), whose tumble rates are drawn from [0,
`LARGEST_TUMBLE`], with camera and scanner in the loop, and prints one row per capture.

The criteria of success, fixed before any result was seen:

* The bar is held: the supervisor is in its mode ``hold``, and the bar is in truth between the fingers' pads, no further
  than `GRIP_LENGTH` from the middle of the hand along it, and than `GRIP_DEPTH` along the direction of approach.
* The relative motion has stopped: the bar moves by less than `CREEP` against the hand, and the arm by less than
  `JOINT_CREEP`, in the last half second.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi
import click
import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from vtbdrake.cli.output import table
from vtbdrake.components.casadi_system.kernel import Kernel
from vtbdrake.rollout import Executor, ProcessExecutor, Quality, RolloutResult, RolloutTask
from vtbdrake.state.systems import pose_from_array
from vtbdrake_diagrams.satellite.bodies import ARM_JOINTS, JOINT_NAMES, Target
from vtbdrake_diagrams.satellite.kinematics import gripper
from vtbdrake_diagrams.satellite.scenario import SatelliteScenario
from vtbdrake_diagrams.satellite.start import Start, random_start
from vtbdrake_diagrams.satellite.supervisor import Mode, Reason

LARGEST_TUMBLE = np.radians(3.0)
HORIZON = 75.0
"""Longest capture in s: the supervisor gives up after 60 s."""
GRIP_LENGTH = 0.06
"""Largest offset of the bar along itself, in m: the bar reaches 0.13 m to both sides, the fingers 0.04 m."""
GRIP_DEPTH = 0.02
"""Largest offset of the bar along the approach, in m.

The pads reach from 0.04 m behind G to 0.05 m before it, the bar 0.033 m to both sides of H.
"""
CREEP = 1e-3
"""Largest motion of the bar in the gripper that counts as none, in m."""
JOINT_CREEP = 2e-3
"""Largest motion of a joint that counts as none, in rad."""

MODE, REASON = "dps.impl.supervisor.mode", "dps.impl.supervisor.reason"
BASE, TARGET = "sim.sys.servicer.base.pose", "sim.sys.target.body.pose"
_JOINTS = tuple(f"sim.sys.servicer.{name}.position" for name in JOINT_NAMES)
_SAMPLE_PERIOD = 0.5


@dataclass(frozen=True)
class Capture:
    """The end of a capture.

    Attributes:
        tumble: Angular velocity of the target in rad/s.
        mode: The last mode of the supervisor.
        reason: Why it was entered.
        duration: In s, until the relative motion had stopped or the capture was aborted.
        offset: p_GoHo_G at the end, in m.
        creep: By how much the bar moved against the hand in the last half second, in m.
        joint_creep: By how much the arm's joints moved then, at most, in rad.
        base_angle: By which angle the base has turned, in rad.
    """

    tumble: float
    mode: str
    reason: str
    duration: float
    offset: np.ndarray
    creep: float
    joint_creep: float
    base_angle: float

    @property
    def failure(self) -> str:
        """Why the capture failed; empty if it succeeded."""
        if self.mode != Mode.HOLD.label:
            return self.reason
        if abs(self.offset[1]) > GRIP_LENGTH or abs(self.offset[2]) > GRIP_DEPTH or abs(self.offset[0]) > 0.01:
            return "the bar is not between the fingers"
        if self.creep > CREEP or self.joint_creep > JOINT_CREEP:
            return "the relative motion has not stopped"
        return ""


def capture_task(scenario: SatelliteScenario) -> RolloutTask:
    """Return the rollouts of a capture, which end when it has succeeded or is aborted."""
    quality = Quality(lambda mode: mode, of=MODE)
    return RolloutTask(
        scenario, HORIZON, quality, Mode.HOLD - 0.5, sample_period=_SAMPLE_PERIOD, record=capture_record()
    )


def capture_record() -> list[str]:
    """Return the addresses that a capture is judged by: mode and reason, and the true poses of bodies and joints."""
    return [MODE, REASON, BASE, TARGET, *_JOINTS]


def judge(result: RolloutResult) -> Capture:
    """Return the end of the capture in a rollout of `capture_task`, from its true motion."""
    record = result.record
    tumble = float(np.linalg.norm(np.asarray(result.parameters["sim.env.release.velocity"])[:3]))
    if result.end == "failed" or len(result.times) < 2:
        return Capture(tumble, "failed", result.message, np.nan, np.full(3, np.nan), np.nan, np.nan, np.nan)
    before, after = fixture_in_gripper(record, -2), fixture_in_gripper(record, -1)
    arm = np.array([[record[address][k] for address in _JOINTS[:ARM_JOINTS]] for k in (-2, -1)])
    return Capture(
        tumble=tumble,
        mode=Mode(int(record[MODE][-1])).label,
        reason=Reason(int(record[REASON][-1])).label,
        duration=float(result.times[-1]),
        offset=after.translation(),
        creep=float(np.linalg.norm(after.translation() - before.translation())),
        joint_creep=float(np.abs(arm[1] - arm[0]).max()),
        base_angle=float(pose_from_array(record[BASE][-1]).rotation().ToAngleAxis().angle()),
    )


def starts(count: int, *, seed: int, distance: float) -> list[Start]:
    """Return random starts with random tumble rates."""
    tumbles = LARGEST_TUMBLE * np.random.default_rng(seed).uniform(size=count)
    return [random_start(seed + k, tumble=float(w), distance=distance) for k, w in enumerate(tumbles)]


def captures(
    scenario: SatelliteScenario, executor: Executor, *, count: int, seed: int
) -> Iterator[tuple[int, Capture]]:
    """Run captures from random starts, and yield them with their numbers as they finish."""
    points = [start.values() for start in starts(count, seed=seed, distance=scenario.distance)]
    for index, result in executor.run(capture_task(scenario), points):
        yield index, judge(result)


def report(captures: Sequence[Capture]) -> str:
    """Return the table of captures, the failures by reason, and the rate of success."""
    header = ("tumble deg/s", "end", "s", "off mm", "creep mm", "base deg", "failure")
    rows = [
        (
            f"{np.degrees(c.tumble):.2f}",
            c.mode,
            f"{c.duration:.1f}",
            " ".join(f"{1e3 * v:.0f}" for v in c.offset),
            f"{1e3 * c.creep:.2f}",
            f"{np.degrees(c.base_angle):.1f}",
            c.failure,
        )
        for c in captures
    ]
    failures = Counter(c.failure for c in captures if c.failure)
    caught = len(captures) - failures.total()
    reasons = "".join(f"\n{count} x {reason}" for reason, count in failures.most_common())
    return f"{table(header, rows)}\n{caught} of {len(captures)} captured{reasons}"


def fixture_in_gripper(record: Mapping[str, Any], k: int) -> RigidTransform:
    """Return X_GH, of the bar in the gripper, in truth, at sample ``k`` of a record with `capture_record`."""
    pose = _gripper().value([np.array([record[address][k] for address in _JOINTS[:ARM_JOINTS]])])
    X_BG = RigidTransform(RotationMatrix(pose[:9].reshape(3, 3)), pose[9:])
    X_BT = pose_from_array(record[BASE][k]).InvertAndCompose(pose_from_array(record[TARGET][k]))
    return X_BG.InvertAndCompose(X_BT @ Target().X_TH)


@lru_cache
def _gripper() -> Kernel:
    q = casadi.SX.sym("q", ARM_JOINTS)
    G = gripper(q)
    pose = casadi.densify(casadi.vertcat(G.R.T.reshape((9, 1)), G.p))
    return Kernel("gripper", [q], pose, compile=False)


@click.command(context_settings={"show_default": True})
@click.option("--captures", "count", default=40, help="Number of captures.")
@click.option("--perception", default="camera+scanner", help="What the tracker follows.")
@click.option("--wheels", is_flag=True, help="Hold the base's attitude by wheels.")
@click.option("--workers", default=2, help="Number of processes.")
@click.option("--seed", default=1000, help="Seed of the first capture.")
def main(count: int, perception: str, wheels: bool, workers: int, seed: int) -> None:
    """Run the campaign, and print its table."""
    scenario = SatelliteScenario(perception=perception, wheels=wheels)
    captures_by_index: dict[int, Capture] = {}
    with ProcessExecutor(workers) as executor:
        for index, capture in captures(scenario, executor, count=count, seed=seed):
            captures_by_index[index] = capture
            print(f"{len(captures_by_index)} of {count}: {capture.failure or 'captured'}", flush=True)
    print(report([captures_by_index[index] for index in sorted(captures_by_index)]))


if __name__ == "__main__":
    main()
