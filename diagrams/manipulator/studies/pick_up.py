"""The arm picks up an unknown load: an alarm, a calibration beside the loop, and decisions with the new model.

``python -m vtbdrake_diagrams.manipulator.studies.pick_up`` prints the table of docs/calibration.md.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from vtbdrake.calibration import ModelRefit, Noise, Refit
from vtbdrake.cli.output import table
from vtbdrake.control import Runtime
from vtbdrake.lcm.hub import Hub
from vtbdrake.machine import MachineProcess
from vtbdrake.monitoring import ResidualMonitor
from vtbdrake.optimization import Choice, Parameter
from vtbdrake.reasoning import BeliefConfig, Budget, Reasoner, SearchConfig
from vtbdrake.recording.replay import replay
from vtbdrake.rollout import Constraint, Quality
from vtbdrake.testbed import DpsAlone
from vtbdrake_diagrams.manipulator.arm import JOINTS, Arm
from vtbdrake_diagrams.manipulator.motions import Motion
from vtbdrake_diagrams.manipulator.scenario import ManipulatorScenario

MASS = "sim.sys.arm.tool.mass"
CENTER = "sim.sys.arm.tool.center_of_mass"
PARAMETERS = (Parameter(MASS, 0.05, 10.0), *(Parameter(f"{CENTER}[{k}]", -0.5, 0.5) for k in range(3)))
KNOWN_AS = {MASS: "dps.tool.mass", **{f"{CENTER}[{k}]": f"dps.tool.center[{k}]" for k in range(3)}}

# Noise of the machine's sensors, in their units, and residuals of its nominal operation, as a learning run finds them.
NOISE = {"joint_position": 1e-5, "joint_velocity": 1e-3, "joint_torque_measured": 0.1, "wrench": 0.1}
TOLERANCE = {
    "sense.joint_position": 1.2e-5,
    "sense.joint_velocity": 1.1e-3,
    "sense.joint_torque_measured": 0.04,
    "sense.wrench": 0.04,
    "act.joint_torque": 0.02,
}
# For the calibration: the encoders' noise, and a disturbance of 0.05 N m that is correlated over 0.05 s.
FIT_NOISE = Noise(np.full(JOINTS, 1e-5), np.full(JOINTS, 0.05), 0.05)

# Duration of the samples for the calibration, in s.
SECONDS = 2.0
# Time after the alarm that is left out of them, in s.
SETTLE = 0.2
# Time that the machine or the calibration may take for an answer, in s: the first one compiles 3 MB of C, which takes
# a busy computer more than five minutes.
_PATIENCE = 1200.0
# Joint 2 must come so close to its reference, in rad.
LARGEST_ERROR = 2.5e-3
STIFFNESS = "dps.impl.stiffness[1]"


@dataclass(frozen=True)
class Load:
    """A load that the arm picks up.

    Attributes:
        mass: In kg.
        place: Its centre in the frame of the tool, (3,), in m.
    """

    mass: float
    place: tuple[float, float, float] = (0.0, 0.0, Arm().tool_length)

    def values(self) -> dict[str, Any]:
        """Return mass and centre of tool and load together, by address."""
        tool, center = Arm().tool_mass, np.array(Arm().tool_inertia().get_com())
        mass = tool + self.mass
        return {MASS: mass, CENTER: (tool * center + self.mass * np.array(self.place)) / mass}


class Outcome(NamedTuple):
    """The events after a load was picked up.

    Attributes:
        refit: The new model.
        to_alarm: Time in s of the DPS from the pick-up to the alarm.
        to_samples: To the last of the samples that the model was fitted to.
        mass_error, center_error: Errors of the new model, in kg and m.
        alarms: Number of alarms that were active before the model was taken, and a second afterwards.
    """

    refit: Refit
    to_alarm: float
    to_samples: float
    mass_error: float
    center_error: float
    alarms: tuple[int, int]


@contextmanager
def arm_loop(scenario: ManipulatorScenario, values: Mapping[str, Any], **options: Any) -> Iterator[tuple[Runtime, Any]]:
    """Run a machine with noisy sensors, and a loop in lock-step with it; yield both, on real."""
    seed = options.pop("seed", 0)
    deployment = scenario.deployment().in_lock_step("wrench", wait=_PATIENCE)
    with (
        Hub(port=0) as hub,
        scenario.deploy(hub.url, target=DpsAlone(scenario), values=values, deployment=deployment, **options) as loop,
        MachineProcess(scenario, hub.url, lock_step=True, noise=NOISE, seed=seed) as machine,
    ):
        end = time.monotonic() + _PATIENCE
        while not all(received.count for received in loop.bridge.sensed.values()):
            if time.monotonic() > end:
                raise TimeoutError(f"the machine has not sent its state within {_PATIENCE:g} s")
            loop.bridge.poll(1.0)
        loop.switch("real")
        loop.cycle()
        yield loop, machine


@contextmanager
def watched(
    loop: Runtime, scenario: ManipulatorScenario, **options: Any
) -> Iterator[tuple[ResidualMonitor, ModelRefit]]:
    """Watch a loop by residuals, and refit the tool after an alarm; see `ModelRefit` for ``options``.

    The residuals are computed in the loop's process, which the machine waits for, so that a trial can be repeated.
    """
    config = replace(scenario.deployment().residuals, tolerance=TOLERANCE)
    with (
        ResidualMonitor(loop, "twin", config=config, keep=2.0 * SECONDS, worker=False) as monitor,
        ModelRefit(
            loop,
            monitor,
            scenario,
            PARAMETERS,
            known_as=KNOWN_AS,
            seconds=SECONDS,
            settle=SETTLE,
            position="joint_position",
            torque="joint_torque",
            segment=0.25,
            noise=FIT_NOISE,
            **options,
        ) as refit,
    ):
        yield monitor, refit


def pick_up(
    loop: Runtime, machine: MachineProcess, load: Load, monitor: ResidualMonitor, refit: ModelRefit, *, at: float = 0.5
) -> Outcome:
    """Let the arm pick up a load after a while, and return what follows.

    Raises:
        RuntimeError: There was an alarm before, none after, or no new model.
    """
    loop.run(cycles=round(at / loop.period))
    if monitor.alarms:
        raise RuntimeError(f"a false alarm: {monitor.alarms[0]}")
    machine.write(load.values())
    begin = loop.time
    loop.run(until=lambda: refit.calibrating, cycles=round(10.0 * SECONDS / loop.period))
    if not refit.calibrating:
        raise RuntimeError(f"no alarm within {loop.time - begin:g} s")
    posted = loop.time
    if not refit.wait(_PATIENCE):
        raise RuntimeError(f"no calibration within {_PATIENCE:g} s")
    before = len(monitor.active())
    loop.run(until=lambda: not refit.pending, cycles=1000)
    if not refit.refits:
        raise RuntimeError(f"no new model: {refit.error}")
    loop.run(cycles=round(1.0 / loop.period))
    new, truth = refit.refits[-1], load.values()
    center = [new.calibration.parameters[f"{CENTER}[{k}]"].value for k in range(3)]
    return Outcome(
        refit=new,
        to_alarm=new.alarm.began - begin,
        to_samples=posted - begin,
        mass_error=new.calibration.parameters[MASS].value - truth[MASS],
        center_error=float(np.linalg.norm(np.array(center) - truth[CENTER])),
        alarms=(before, len(monitor.active())),
    )


def reasoner(scenario: ManipulatorScenario, refit: Refit | None = None) -> Reasoner:
    """Return what decides how stiff joint 2, which carries most, is in the next motion: as soft as it may be.

    Args:
        scenario: The scenario of the arm.
        refit: The new model, whose deviations are the uncertainty of the belief; None: the belief is certain.
    """
    belief = None
    if refit is not None:
        parameters = refit.calibration.parameters
        deviations = [parameters[f"{CENTER}[{k}]"].deviation for k in range(3)]
        belief = BeliefConfig(samples=3, uncertainty={MASS: parameters[MASS].deviation, CENTER: np.array(deviations)})
    return Reasoner(
        scenario=scenario,
        decision=[Choice(STIFFNESS, [800.0, 1600.0, 3200.0])],
        quality=Quality(float, of=STIFFNESS, reading="end", minimize=True),
        constraints=[
            Constraint(
                lambda reference, position: abs(reference - position),
                of=["dps.impl.reference[1]", "dps.env.joint_position[1]"],
                at_most=LARGEST_ERROR,
                # At first it sags as it does now.
                reading="end",
            )
        ],
        horizon=1.5,
        sample_period=0.1,
        budget=Budget(rollouts=4 if refit is None else 12),
        search=SearchConfig(method="grid", executor="serial"),
        belief=belief,
    )


def motion_values(random: np.random.Generator) -> dict[str, Any]:
    """Return a random motion: swings or circles, of random durations."""
    return {
        "u.motion": float(random.choice([Motion.SWING, Motion.CIRCLE])),
        "dps.impl.home_duration": 0.5,
        "dps.impl.swing_duration": random.uniform(3.0, 5.0),
        "dps.impl.circle_duration": random.uniform(2.5, 4.0),
        "dps.impl.circle_radius": random.uniform(0.06, 0.12),
    }


@click.command()
@click.option("--trials", default=20, show_default=True, help="Number of loads.")
def main(trials: int) -> None:
    """Let the arm pick up loads of 0.1 to 1 kg during different motions."""
    scenario = ManipulatorScenario(law="joint_impedance", knows_tool=True)
    outcomes, rows = [], []
    for trial in range(trials):
        random = np.random.default_rng(trial)
        place = (*random.uniform(-0.03, 0.03, 2), random.uniform(0.08, 0.16))
        load = Load(0.4 if trial == 0 else float(random.uniform(0.1, 1.0)), place)
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder) / "log"
            with (
                arm_loop(scenario, motion_values(random), seed=trial, record=log) as (loop, machine),
                watched(loop, scenario) as (monitor, refit),
            ):
                outcome = pick_up(loop, machine, load, monitor, refit)
            identical = replay(log).identical
        outcomes.append(outcome)
        mass = outcome.refit.calibration.parameters[MASS]
        rows.append(
            (
                f"{load.mass:.3f}",
                f"{1e3 * outcome.to_alarm:.0f} ms",
                f"{outcome.to_samples:.2f} s",
                f"{outcome.refit.took:.1f} s",
                f"{1e3 * outcome.mass_error:+.2f} ({1e3 * mass.deviation:.2f}) g",
                f"{1e3 * outcome.center_error:.2f} mm",
                "yes" if outcome.refit.accepted else "no",
                f"{outcome.alarms[0]} / {outcome.alarms[1]}",
                "yes" if identical else "NO",
            )
        )
        print(" | ".join(rows[-1]), flush=True)
    header = ("load / kg", "alarm", "samples", "computed", "mass error", "centre", "accepted", "alarms", "replay")
    print(table(header, rows))
    errors = np.array([abs(outcome.mass_error) for outcome in outcomes])
    inside = np.mean([abs(o.mass_error) <= 1.96 * o.refit.calibration.parameters[MASS].deviation for o in outcomes])
    alarm = [outcome.to_alarm for outcome in outcomes]
    print(
        f"\nmass error: median {1e3 * np.median(errors):.2f} g, largest {1e3 * errors.max():.2f} g; within its "
        f"interval of 95 %: {inside:.0%}; pick-up to alarm: median {1e3 * np.median(alarm):.0f} ms, largest "
        f"{1e3 * max(alarm):.0f} ms"
    )


if __name__ == "__main__":
    main()
