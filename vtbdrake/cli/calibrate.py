"""``vtbdrake calibrate``: fit numbers of a testbed to recordings, or test on simulated machines how well that works."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vtbdrake.cli import FailedError
from vtbdrake.cli.options import (
    Setting,
    assignment,
    option,
    output,
    parse_scaled_range,
    parse_setting,
    scenario_argument,
    settings,
)
from vtbdrake.cli.output import json_option, show
from vtbdrake.machine.config import MachineConfig

if TYPE_CHECKING:
    from vtbdrake.calibration import SelfTest
    from vtbdrake.common.arrays import Array
    from vtbdrake.optimization import Parameter
    from vtbdrake.recording import Log
    from vtbdrake.testbed import Scenario


# Largest torque of a signal without bounds, in N m or N.
_LARGEST = 100.0
_ALL_DRIVES = "drives"


def _parse_varied(text: str) -> Any:
    """Return a Parameter, or the word for all drives."""
    return text if text == _ALL_DRIVES else parse_scaled_range(text)


def _varied(scenario: Scenario, torque: str, parameters: Sequence[Any]) -> list[Parameter]:
    """Return the parameters, with the friction of all drives in place of the word.

    Raises:
        click.UsageError: The scenario has no drives.
    """
    if _ALL_DRIVES not in parameters:
        return list(parameters)
    import numpy as np

    from vtbdrake.optimization import Parameter

    addresses = [address for address in scenario.build().variables() if address.startswith("sim.act.")]
    paths = [address.removesuffix(".coulomb") for address in addresses if address.endswith(".coulomb")]
    if len(paths) != 1:
        raise click.UsageError(
            f"--vary drives is for a scenario with one JointDrives, this one has {len(paths)}; a project of `vtbdrake "
            "new` has them with --field drives=true"
        )
    signal = next((each for each in scenario.interface().act if each.name == torque), None)
    listed = {each.address for each in parameters if each != _ALL_DRIVES}
    upper = np.inf if signal is None else signal.upper
    bounds: Array = np.broadcast_to(np.asarray(upper, dtype=float), (1 if signal is None else int(signal.size or 1),))
    drives = []
    for i, bound in enumerate(bounds):
        largest = float(bound) if np.isfinite(bound) else _LARGEST
        addresses = [f"{paths[0]}.{name}[{i}]" for name in ("coulomb", "viscous")]
        drives += [Parameter(address, 0.0, largest) for address in addresses if address not in listed]
    return [*(each for each in parameters if each != _ALL_DRIVES), *drives]


@click.command()
@scenario_argument
@click.argument("logs", nargs=-1, type=click.Path(exists=True, dir_okay=False, path_type=Path))
@option(
    "--vary ADDRESS=LOWER:UPPER",
    "A number of the plant or of its drives, and its range; or `drives`: Coulomb and viscous friction of all joints, "
    "from 0 to the bounds of the torque. May be repeated.",
    name="parameters",
    parse=_parse_varied,
    multiple=True,
)
@option("--inertia ADDRESS", "A body whose ten inertial parameters are fitted. May be repeated.", multiple=True)
@option("--position SIGNAL", "The sensor signal of the joint positions.", required=True)
@option("--torque SIGNAL", "The actuator signal of the joint torques.", required=True)
@option("--measured-torque", "The torques were measured in the drives, they are no commands.", is_flag=True)
@option("--period S", "Compare positions only about every S seconds.", type=float)
@option("--position-columns COLUMNS", "Columns of the positions in a table, COLUMN[,COLUMN...].", default="")
@option("--torque-columns COLUMNS", "Columns of the torques in a table.", default="")
@option("--time COLUMN", "Column of the times in a table.", default="time")
@option(
    "--unit NAME=UNIT",
    "Unit of a signal, of one column or of the times in a table, if it is none of SI. May be repeated.",
    name="units",
    parse=partial(assignment, form="NAME=UNIT"),
    multiple=True,
)
@option("--save FILE", "Write the calibrated scenario: .yaml.", parse=output(".yaml"))
@option("--html FILE", "Write a page with the numbers, their verdicts and plots: .html.", parse=output(".html"))
@json_option
@option("--self-test", "Calibrate simulated machines whose numbers are hidden, instead of LOGS.", is_flag=True)
@option(
    "--set ADDRESS=VALUE",
    "Self-test: set a variable of the DPS at the start, such as its plan. May be repeated.",
    name="values",
    parse=parse_setting,
    multiple=True,
)
@option("--trials N", "Self-test: number of machines.", type=click.IntRange(min=1), default=10)
@option("--seconds S", "Self-test: duration of each log.", type=click.FloatRange(0.1), default=10.0)
@option(
    "--disturbance TORQUE",
    "Self-test: standard deviation of a torque that no log contains, in N m.",
    type=click.FloatRange(0.0),
    default=0.0,
)
@option("--seed N", "Self-test: seed of truths and disturbances.", type=click.IntRange(min=0), default=0)
def calibrate(
    scenario: Scenario,
    logs: tuple[Path, ...],
    parameters: tuple[Any, ...],
    inertia: tuple[str, ...],
    position: str,
    torque: str,
    measured_torque: bool,
    period: float | None,
    save: Path | None,
    html: Path | None,
    self_test: bool,
    values: tuple[Setting, ...],
    trials: int,
    seconds: float,
    disturbance: float,
    seed: int,
    **table: Any,
) -> None:
    """Fit numbers of a testbed to recordings, with verdicts.

    LOGS are logs of control loops or of lcm-logger, or tables (.csv, .npz, .parquet, .mcap) whose columns the options
    name. The exit code is 1 unless every number is accepted.

    With --self-test, machines with random numbers in the ranges are simulated in processes of their own, commanded by
    the scenario's DPS over LCM, and calibrated: it shows, before any hardware is touched, what a log will tell.

    \b
    Example:
      vtbdrake calibrate double_pendulum swing.csv \\
        --position joint_position --position-columns q1,q2 --torque torque --torque-columns tau1,tau2 \\
        --vary sim.sys.pendulum.lower.mass=0.1:2 --vary sim.act.drives.coulomb[0]=0:1 --save pendulum.yaml
      vtbdrake calibrate manipulator --self-test --position joint_position \\
        --torque joint_torque --vary sim.sys.arm.tool.mass=0.2:2
    """
    if bool(logs) == self_test:
        raise click.UsageError("give either LOGS or --self-test")
    if values and not self_test:
        raise click.UsageError("--set is for the DPS of a --self-test: the DPS takes no part in the fit of LOGS")
    for name, file in (("save", save), ("html", html)):
        if self_test and file is not None:
            raise click.UsageError(f"a self-test has nothing to --{name}: it calibrates machines that do not exist")
    from vtbdrake.calibration import Inertia
    from vtbdrake.calibration import calibrate as fit
    from vtbdrake.calibration import self_test as test

    varied = _varied(scenario, torque, parameters)
    model: dict[str, Any] = {
        "inertias": [Inertia(address) for address in inertia],
        "position": position,
        "torque": torque,
        "measured_torque": measured_torque,
        "period": period,
    }
    if self_test:
        machine = MachineConfig(disturbance={torque: disturbance} if disturbance else {})
        trial: dict[str, Any] = {"seconds": seconds, "trials": trials, "seed": seed, "values": settings(values)}
        tested = test(scenario, varied, machine=machine, **trial, **model)
        show(tested, _tested(tested))
        return
    recordings = [_read(path, scenario, position, torque, **table) for path in logs]
    result = fit(scenario, recordings, varied, progress=True, **model)
    names = ("fit", "holdout", "correlation", "reasons", "combinations", "remarks")
    numbers = {"parameters": [*result.parameters.values()]}
    show(result, numbers | {name: getattr(result, name) for name in names})
    if save is not None:
        result.scenario.save(save)
    if html is not None:
        result.save_html(html)
    if not result.accepted:
        refused = [each.address for each in result.parameters.values() if each.verdict != "accepted"]
        raise FailedError(f"not accepted: {', '.join(refused)}")


def _read(
    path: Path,
    scenario: Scenario,
    position: str,
    torque: str,
    *,
    position_columns: str,
    torque_columns: str,
    time: str,
    units: Sequence[tuple[str, str]],
) -> Log:
    from vtbdrake.recording import read_log, read_table
    from vtbdrake.recording.table_reader import READERS

    if path.suffix.lower() not in READERS:
        return read_log(path, scenario)
    if not (position_columns and torque_columns):
        raise click.UsageError(f"{path} is a table: name its columns by --position-columns and --torque-columns")
    return read_table(
        path,
        sense={position: position_columns.split(",")},
        act={torque: torque_columns.split(",")},
        time=time,
        units=settings(units),
    )


def _tested(result: SelfTest) -> dict[str, Any]:
    numbers = [
        {
            "address": address,
            "truths": [trial.truth[address] for trial in result.trials],
            "errors": result.errors(address),
            "covered": int(result.covered(address).sum()),
            "intervals": int(result.covered(address).size),
        }
        for address in result.addresses
    ]
    return {"parameters": numbers, "trials": len(result.trials), "coverage": result.coverage}
