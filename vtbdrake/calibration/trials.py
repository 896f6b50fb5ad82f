"""Self-test: how near a calibration comes to truths that are hidden from it, before any hardware is touched."""

from __future__ import annotations

import logging
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vtbdrake.calibration.calibration import calibrate
from vtbdrake.calibration.calibration_result import Calibration, Verdict
from vtbdrake.calibration.joint_model import CalibrationError, Inertia, body_numbers
from vtbdrake.common.arrays import Array
from vtbdrake.common.interrupt import interrupt_taken
from vtbdrake.lcm.hub import Hub
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.machine import MachineConfig, MachineError, MachineProcess
from vtbdrake.optimization import Parameter
from vtbdrake.recording import Log, read_log
from vtbdrake.state.variables import text_table
from vtbdrake.testbed import Scenario
from vtbdrake.testbed.inertia import physical_numbers

_log = logging.getLogger(__name__)

_PATIENCE = 60.0  # s
# How far the numbers of a hidden inertia lie from the scenario's numbers: 0.05 is 10 % of the mass.
_INERTIA_SPREAD = 0.05


@dataclass(frozen=True, eq=False)
class SelfTestTrial:
    """One hidden truth, and the result of calibrating its log.

    Attributes:
        truth: The values of the machine, by address.
        calibration: The calibration, which did not know them.
    """

    truth: Mapping[str, float]
    calibration: Calibration


@dataclass(frozen=True, eq=False)
class SelfTest:
    """The result of `self_test`.

    Attributes:
        trials: The trials.
    """

    trials: tuple[SelfTestTrial, ...]

    @property
    def addresses(self) -> tuple[str, ...]:
        """Return the calibrated numbers."""
        return tuple(self.trials[0].truth)

    def errors(self, address: str) -> Array:
        """Return the differences of the estimates from the truths, shape (trials,)."""
        pairs = [(trial.calibration.parameters[address].value, trial.truth[address]) for trial in self.trials]
        return np.array([value - truth for value, truth in pairs])

    def covered(self, address: str) -> Array:
        """Return in which trials the interval of 95 % contains the truth, shape (trials,).

        Trials in which the number was not identifiable claim nothing, and are left out.
        """
        results = [(trial.calibration.parameters[address], trial.truth[address]) for trial in self.trials]
        return np.array(
            [r.lower <= truth <= r.upper for r, truth in results if r.verdict != Verdict.NOT_IDENTIFIABLE],
            dtype=bool,
        )

    @property
    def coverage(self) -> float:
        """Return the share of all intervals that contain the truth; 0.95 is expected, NaN without an interval."""
        covered = np.concatenate([self.covered(address) for address in self.addresses])
        return float(covered.mean()) if covered.size else float("nan")

    def __str__(self) -> str:
        rows, total = [], 0
        for address in self.addresses:
            sizes, covered = abs(self.errors(address)), self.covered(address)
            scale = float(np.median([abs(trial.truth[address]) for trial in self.trials]))
            median, most = np.quantile(sizes, [0.5, 0.95])
            relative = [f"{100.0 * value / scale:.2g} %" if scale > 0.0 else "" for value in (median, most)]
            verdicts = [str(trial.calibration.parameters[address].verdict) for trial in self.trials]
            counts = ", ".join(f"{verdicts.count(name)} {name}" for name in dict.fromkeys(verdicts))
            total += covered.size
            errors = [f"{median:.3g}", relative[0], f"{most:.3g}", relative[1]]
            rows.append((address, *errors, f"{covered.sum()} of {covered.size}", counts))
        header = ("calibrated", "median error", "", "95 % within", "", "covered", "verdicts")
        summary = f"{len(self.trials)} hidden truths: {self.coverage:.1%} of {total} intervals of 95 % contain theirs"
        return f"{text_table(header, rows)}\n{summary}"


def self_test(
    scenario: Scenario,
    parameters: Sequence[Parameter] = (),
    *,
    inertias: Sequence[Inertia] = (),
    position: str,
    torque: str,
    seconds: float = 10.0,
    trials: int = 20,
    seed: int = 0,
    machine: MachineConfig | None = None,
    values: Mapping[str, Any] | None = None,
    **options: Any,
) -> SelfTest:
    """Calibrate simulated machines whose numbers are known, but not to the calibration.

    In each trial the numbers are drawn uniformly from their ranges (delays in whole periods, as `JointDrives` has
    them; a whole inertia near the scenario's). A machine with these numbers, in a process of its own, is
    commanded by the scenario's DPS over LCM, and the log is calibrated.

    Args:
        scenario: The scenario, with the errors of its sensors (resolution of the encoders).
        parameters: As in `calibrate`.
        inertias: As in `calibrate`.
        position: As in `calibrate`.
        torque: As in `calibrate`.
        seconds: The duration of a log.
        trials: The number of truths.
        seed: The seed of truths and disturbances.
        machine: What else the machine does: noise, disturbances that no log contains.
        values: Values of variables of the DPS at the start, such as the plan of `excitation`, by address.
        **options: Further arguments of `calibrate`.

    An interrupt (Ctrl-C), or a machine that does not start, ends it with the trials that are done by then.

    Raises:
        CalibrationError: As in `calibrate`, and if the machine cannot be commanded.
        KeyboardInterrupt: The first trial was interrupted.
        MachineError: The first machine did not start.
    """
    if trials < 1:
        raise CalibrationError(f"a self-test takes at least one trial, not {trials}")
    generator, testbed, results = np.random.default_rng(seed), scenario.build(), []
    context = testbed.default_context()
    try:
        for number in range(trials):
            begin = time.process_time()
            truth = {parameter.address: _drawn(parameter, generator) for parameter in parameters}
            for inertia in inertias:
                start = body_numbers(testbed, context, inertia.address)
                size = np.array([1.0] * 4 + [float(np.exp(start[1:4]).mean())] * 6)
                z = start + _INERTIA_SPREAD * size * generator.normal(size=start.size)
                truth |= physical_numbers(inertia.address, z)
            config = replace(machine or MachineConfig(), seed=int(generator.integers(2**31)))
            config = replace(config, values={**config.values, **truth})
            log = machine_log(scenario, seconds, machine=config, values=values)
            calibration = calibrate(
                scenario, log, parameters, inertias=inertias, position=position, torque=torque, **options
            )
            results.append(SelfTestTrial(truth, calibration))
            _log.info("trial %d of %d is done, in %.0f s of CPU", number + 1, trials, time.process_time() - begin)
    except (KeyboardInterrupt, MachineError) as error:
        if not results:
            raise
        _log.warning("%s: %d of %d trials are done", str(error) or "interrupted", len(results), trials)
        interrupt_taken()
    return SelfTest(tuple(results))


def machine_log(
    scenario: Scenario,
    seconds: float,
    *,
    machine: MachineConfig | None = None,
    values: Mapping[str, Any] | None = None,
) -> Log:
    """Return the log of a scenario's DPS that commands a simulated machine of the same scenario, over LCM.

    Machine and DPS run in lock-step, so that the log does not depend on the load of this computer. There, an answer
    arrives within the period of its state; it is held back for a period, as it takes in the testbed.

    Args:
        scenario: The scenario; its deployment describes messages and guards.
        seconds: The duration of the log.
        machine: The differences of the machine from the scenario's world.
        values: Values of variables of the DPS at the start, such as its plan, by address.

    Raises:
        CalibrationError: The DPS could not take over, or its guards stopped it.
        ProtocolError: The scenario has no protocol.
    """
    if not seconds > 0.0:
        raise CalibrationError(f"a log takes a positive time in s, not {seconds}")
    protocol, config = protocol_of(scenario), machine or MachineConfig()
    deployment = scenario.deployment().in_lock_step(protocol.sense[-1].signals[0], wait=_PATIENCE)
    config = replace(config, act_latency=config.act_latency + deployment.period)
    with tempfile.TemporaryDirectory() as folder, Hub(port=0) as hub:
        path = Path(folder) / "machine.lcm"
        with (
            MachineProcess(scenario, hub.url, config, lock_step=True),
            scenario.deploy(hub.url, values=values, deployment=deployment, record=path) as loop,
        ):
            deadline = time.monotonic() + _PATIENCE
            while (preparation := loop.prepare("real")).reasons:
                if time.monotonic() > deadline:
                    raise CalibrationError(f"the DPS cannot take over: {'; '.join(preparation.reasons)}")
                loop.bridge.poll(0.5)
            loop.perform(preparation)
            begin = loop.time
            loop.cycle()  # The first actuator command begins the exchange.
            loop.run(cycles=max(round(seconds / deployment.period) - 1, 0))
            if latched := loop.guards.latched:
                reasons = "; ".join(fault.reason for fault in latched)
                raise CalibrationError(f"the guards stopped the DPS, so that there is no log: {reasons}")
        # A half period more: the last command is stamped at the end of its cycle.
        return read_log(path).signals.between(begin, begin + seconds + 0.5 * deployment.period)


def _drawn(parameter: Parameter, generator: np.random.Generator) -> float:
    value = float(parameter.from_unit(generator.uniform()))
    return float(round(value)) if parameter.address.endswith(".delay") else value
