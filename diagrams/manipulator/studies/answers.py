"""Row C1 of the table of answers: the tracking error of the arm on the machine and in simulation."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context

from vtbdrake.common.arrays import rms
from vtbdrake.control import Runtime, SimulatedClock
from vtbdrake.control.stepping import Cycle
from vtbdrake.lcm.hub import Hub
from vtbdrake.machine import MachineProcess
from vtbdrake.testbed import DpsAlone, VirtualTestbed
from vtbdrake_diagrams.answers import Answer
from vtbdrake_diagrams.manipulator.scenario import ManipulatorScenario
from vtbdrake_diagrams.manipulator.studies.trials import (
    DURATIONS,
    FREE,
    PROGRAM,
    LawAlongX,
    RestingForce,
    Track,
    Trial,
    run_trial,
    trial_scenario,
)

LAWS = {"impedance": "cartesian_impedance", "admittance": "admittance"}
# The laws that an engineer would take for motions alone -> their gains, which a scale multiplies by its square and
# by itself. The second is Drake's `InverseDynamicsController`.
BASELINES = {
    "joint_impedance": ("stiffness", "damping"),
    "inverse_dynamics": ("position_gain", "velocity_gain"),
}
# The scales among which they are tuned in simulation; the laws of `LAWS` keep their default gains.
SCALES = (1.0, 1.5, 2.0)

# Masses, friction and other parameters of the machine differ from the DPS's by up to this fraction.
PERTURB = 0.05
# Seed by which they are drawn.
SEED = 7

# Largest tracking error of the tip, RMS, in m.
TOLERANCE = 0.005
# Largest ratio of the tracking error on the machine to the one in simulation.
RATIO = 2.0
# Largest difference of the force on the wall from statics, in simulation and on the machine.
FORCE_TOLERANCE = 0.05

# Cycles for which the whole testbed commands the machine, in the short version; fewer show nothing.
COMPARED = 3000

# The time to wait for the next message of the machine, which begins a cycle, in s.
PATIENCE = 60.0


@dataclass
class Trials:
    """Results of one control law: the same motions in simulation, and on the machine by the DPS alone.

    Attributes:
        simulated, real: The tracks in simulation and on the machine.
        pressed: The forces on the wall at rest, in simulation and on the machine.
        compared: The number of cycles in which the whole testbed commanded a machine of its own.
        identical: Whether the DPS alone sent the same actuator commands in these cycles, bit for bit.
        latched: The faults for which the guards latched; empty if they did not.
    """

    simulated: Track
    real: Track
    pressed: tuple[RestingForce, RestingForce]
    compared: int
    identical: bool
    latched: str

    @property
    def errors(self) -> tuple[float, float]:
        """Return the tracking errors of the tip in simulation and on the machine, RMS, in m."""
        return rms(self.simulated.errors()), rms(self.real.errors())

    @property
    def holds(self) -> bool:
        """Return whether the arm follows its motions and presses as statics says in both, by the same commands.

        Testbed and DPS alone have to send the same ones.
        """
        simulated, real = self.errors
        follows = simulated <= TOLERANCE and real <= min(TOLERANCE, RATIO * simulated)
        presses = all(force.error <= FORCE_TOLERANCE for force in self.pressed)
        return follows and presses and self.identical and self.compared >= COMPARED and not self.latched


def best_scale(scores: Mapping[float, float]) -> float:
    """Return the scale with the least error; NaN is none.

    Args:
        scores: Scale -> error.
    """
    return min(scores, key=lambda scale: np.nan_to_num(scores[scale], nan=np.inf))


@dataclass(frozen=True)
class Baseline:
    """A law for motions alone, tuned in simulation, on the machine.

    Attributes:
        scores: Scale of the gains -> tracking error of the tip in simulation, RMS, in m.
        real: The track on the machine, with the best scale.
        latched: The faults for which the guards latched; empty if they did not.
    """

    scores: Mapping[float, float]
    real: Track
    latched: str

    @property
    def scale(self) -> float:
        """Return the scale with the least error in simulation."""
        return best_scale(self.scores)

    def __str__(self) -> str:
        error, effort = rms(self.real.errors()), self.real.effort()
        latched = f", LATCHED: {self.latched}" if self.latched else ""
        return f"{1e3 * error:.2f} mm, gains x {self.scale:g}, {effort:.0f} N m{latched}"


def control(full: bool) -> Answer:
    """Measure how well the arm tracks its motions, on the machine and in simulation.

    The loop runs in lock-step with the machine, so the answer does not depend on the load of this computer. The short
    version compares testbed and DPS alone in the first `COMPARED` cycles, the long one in all.
    """
    trials = {name: _trials(law, full) for name, law in LAWS.items()}
    errors = {name: trial.errors for name, trial in trials.items()}
    baselines = {law: _baseline(law) for law in BASELINES}
    cycles = sum(trial.compared for trial in trials.values())
    same = "identical" if all(trial.identical for trial in trials.values()) else "DIFFERENT"
    latched = "; ".join(trial.latched for trial in trials.values() if trial.latched)
    return Answer(
        id="C1",
        question="How well does an arm follow its motions when the switches of its testbed are thrown to the machine?",
        answer=", ".join(f"{name} {1e3 * real:.2f} mm" for name, (_, real) in errors.items()),
        unit="(RMS of the tip, machine)",
        interval=None,
        paper="done with a real arm, 1 ms; no figures",
        cases="one program of motions, both control laws, in simulation",
        held_out=f"the same motions on a machine process whose parameters differ by up to {PERTURB:.0%}",
        baseline="for motions alone, on the same machine, tuned in simulation: "
        + "; ".join(f"{name.replace('_', ' ')} {baseline}" for name, baseline in baselines.items()),
        holds=all(trial.holds for trial in trials.values()),
        note=(
            "in simulation "
            + ", ".join(f"{name} {1e3 * simulated:.2f} mm" for name, (simulated, _) in errors.items())
            + ". Torque: "
            + ", ".join(f"{name} {trial.real.effort():.0f} N m" for name, trial in trials.items())
            + ". Force on the wall: "
            + "; ".join(f"{name} {_forces(trial)}" for name, trial in trials.items())
            + f". Commands of testbed and DPS alone: {same} in "
            + f"{cycles} cycles. "
            + (f"The guards latched: {latched}." if latched else "The guards never latched.")
        ),
    )


def _forces(trial: Trials) -> str:
    simulated, real = trial.pressed
    return (
        f"by the statics of two springs {simulated.predicted:.1f} N, in simulation {simulated.felt:.1f} N, on the "
        f"machine {real.felt:.1f} N (off by {real.error:.1%})"
    )


def _trials(law: str, full: bool) -> Trials:
    scenario = trial_scenario(law)
    testbed, alone = scenario.build(), DpsAlone(scenario)
    sent_by_testbed: list[NDArray[np.float64]] = []
    sent_by_dps: list[NDArray[np.float64]] = []
    with _simulating(scenario, testbed, DURATIONS) as simulation:
        simulated = run_trial(simulation)
    stripped = alone.continue_from(testbed, simulation.context)
    with _commanding(scenario, testbed, simulation.context, sent_by_testbed) as loop:
        loop.run(until=Trial(loop, PROGRAM), cycles=None if full else COMPARED)
        latched = loop.guards.latched
    with _commanding(scenario, alone, stripped, sent_by_dps) as loop:
        track = run_trial(loop)
        latched += loop.guards.latched
    compared = min(len(sent_by_testbed), len(sent_by_dps))
    along_x = LawAlongX.of(testbed)
    return Trials(
        simulated,
        track,
        (simulated.pressing(along_x, scenario), track.pressing(along_x, scenario)),
        compared,
        np.array_equal(sent_by_testbed[:compared], sent_by_dps[:compared]),
        "; ".join(fault.reason for fault in latched),
    )


def _baseline(law: str) -> Baseline:
    scenario = trial_scenario(law)
    testbed, alone = scenario.build(), DpsAlone(scenario)
    scores = {}
    for scale in SCALES:
        with _simulating(scenario, testbed, DURATIONS | _gains(testbed, law, scale)) as simulation:
            scores[scale] = rms(run_trial(simulation, FREE).errors())
    scale = best_scale(scores)
    context = alone.default_context()
    alone.write(context, DURATIONS | _gains(testbed, law, scale))
    with _commanding(scenario, alone, context, []) as loop:
        track = run_trial(loop, FREE)
        return Baseline(scores, track, "; ".join(fault.reason for fault in loop.guards.latched))


def _gains(testbed: VirtualTestbed, law: str, scale: float) -> dict[str, Any]:
    """Return the gains of a baseline, as stiff as the square of a scale and as well damped."""
    stiffness, damping = (f"dps.impl.{name}" for name in BASELINES[law])
    context = testbed.default_context()
    return {
        stiffness: scale**2 * np.asarray(testbed.read(context, stiffness)),
        damping: scale * np.asarray(testbed.read(context, damping)),
    }


@contextmanager
def _simulating(scenario: ManipulatorScenario, testbed: VirtualTestbed, values: Mapping[str, Any]) -> Iterator[Runtime]:
    """Run the loop in its own simulation, as fast as it goes."""
    by_the_clock = replace(scenario.deployment(), pace="")
    with (
        Hub(port=0) as hub,
        scenario.deploy(
            hub.url, target=testbed, values=values, deployment=by_the_clock, clock=SimulatedClock()
        ) as simulation,
    ):
        yield simulation


@contextmanager
def _commanding(
    scenario: ManipulatorScenario,
    target: VirtualTestbed | DpsAlone,
    context: Context,
    sent: list[NDArray[np.float64]],
) -> Iterator[Runtime]:
    """Start a machine and a loop in lock-step with it, on real; collect the torques in ``sent``, shape (7,) each.

    They have a hub of their own: the channel of commands belongs to a loop for a while after its end.
    """

    def collect(cycle: Cycle) -> None:
        sent.append(cycle.verdict.actuation["joint_torque"].copy())

    deployment = scenario.deployment().in_lock_step("wrench", wait=PATIENCE)
    with (
        Hub(port=0, protect=["IIWA_COMMAND"]) as hub,
        scenario.deploy(hub.url, target=target, context=context, deployment=deployment, watchers=(collect,)) as loop,
        MachineProcess(scenario, hub.url, lock_step=True, perturb=PERTURB, seed=SEED),
    ):
        deadline = time.monotonic() + PATIENCE
        while not all(received.count for received in loop.bridge.sensed.values()):
            if time.monotonic() > deadline:
                raise TimeoutError(f"the machine has not sent its state within {PATIENCE:g} s")
            loop.bridge.poll(1.0)
        loop.switch("real")
        # The first actuator command begins the exchange.
        loop.cycle()
        yield loop
