"""``vtbdrake machine``: a process that plays the physical robot."""

from __future__ import annotations

import logging
from math import inf

import click

from vtbdrake.cli.group import FailedError, one_line
from vtbdrake.cli.options import (
    Setting,
    converted,
    parse_setting,
    scenario_argument,
    set_option,
    settings,
    url_option,
)
from vtbdrake.cli.text import number
from vtbdrake.control.bridge import BridgeError
from vtbdrake.machine import Machine, MachineConfig
from vtbdrake.machine.config import BRAKES
from vtbdrake.machine.serve import epoch, serve
from vtbdrake.testbed import Scenario

_DEFAULT = MachineConfig()


def _parse_noise(text: str) -> tuple[str, float]:
    try:
        name, value = parse_setting(text)
    except click.BadParameter as error:
        raise click.BadParameter(f"it takes SIGNAL=STD, a number, not {text!r}") from error
    if isinstance(value, list):
        raise click.BadParameter(f"the noise of {name} is one standard deviation for all its entries, not {value}")
    return name, value


@click.command("machine")
@scenario_argument
@url_option
@click.option(
    "--period",
    type=float,
    default=_DEFAULT.period,
    show_default=True,
    metavar="S",
    help="Of a cycle, in seconds: it tells its state once in each.",
)
@click.option(
    "--lock-step", is_flag=True, help="Begin a cycle with a command on every channel, instead of with the clock."
)
@click.option("--cycles", type=click.IntRange(min=0), metavar="N", help="End after so many; endless by default.")
@set_option
@click.option(
    "--perturb",
    type=float,
    default=_DEFAULT.perturb,
    metavar="R",
    help="Multiply masses, damping, friction and rotor inertias by random factors from 1 - R to 1 + R.",
)
@click.option(
    "--noise",
    callback=converted(_parse_noise),
    multiple=True,
    metavar="SIGNAL=STD",
    help="Normal noise on a sensor signal, in its unit. May be repeated.",
)
@click.option("--seed", type=int, default=_DEFAULT.seed, show_default=True, metavar="N", help="Of all random numbers.")
@click.option(
    "--sense-delay", type=float, default=0.0, metavar="MS", help="Of its messages, in milliseconds; whole cycles."
)
@click.option("--act-delay", type=float, default=0.0, metavar="MS", help="Of commands, in milliseconds; whole cycles.")
@click.option(
    "--timeout",
    type=float,
    default=_DEFAULT.timeout,
    show_default=True,
    metavar="S",
    help="Seconds without a command after which it brakes.",
)
@click.option(
    "--max-delay",
    type=float,
    default=_DEFAULT.max_delay,
    show_default=True,
    metavar="S",
    help="Refuse commands that took so much longer than the quickest one, by their sender's clock; inf: none. Not in "
    "lock-step.",
)
@click.option(
    "--brake",
    type=click.Choice(BRAKES),
    help="Lock the joints (the default where the plant is discrete), give the idle commands (the default elsewhere) or "
    "hold the last ones.",
)
@click.option(
    "--priority",
    type=click.IntRange(0, 99),
    default=0,
    show_default=True,
    metavar="N",
    help="Of real-time scheduling (SCHED_FIFO), 1 to 99, where the system grants it.",
)
def run_machine(
    scenario: Scenario,
    url: str,
    period: float,
    lock_step: bool,
    cycles: int | None,
    values: tuple[Setting, ...],
    perturb: float,
    noise: tuple[tuple[str, float], ...],
    seed: int,
    sense_delay: float,
    act_delay: float,
    timeout: float,
    max_delay: float,
    brake: str | None,
    priority: int,
) -> None:
    """Play the physical robot of a scenario over LCM, until Ctrl-C.

    The scenario says by its method protocol() on which channels. Faults can be requested on VTB_MACHINE, as JSON, such
    as {"fault": "drop", "fraction": 0.5} or {"request": "normal"}; VTB_MACHINE_STATUS says how the machine is.

    \b
    Example:
      vtbdrake machine diagrams.manipulator:ManipulatorScenario --url tcpq://127.0.0.1:7700 \\
          --perturb 0.05 --seed 3
    """
    logging.basicConfig(format="%(asctime)s %(message)s", level=logging.INFO)
    config = MachineConfig(
        period=period,
        values=settings(values),
        perturb=perturb,
        noise=dict(noise),
        seed=seed,
        sense_delay=1e-3 * sense_delay,
        act_delay=1e-3 * act_delay,
        timeout=timeout,
        max_delay=max_delay,
        brake=brake or "",
    )
    machine = Machine(scenario, config, epoch=epoch(lock_step=lock_step))
    for address, value in machine.perturbed.items():
        click.echo(f"{address} = {value}")
    try:
        loop = serve(
            machine,
            url,
            lock_step=lock_step,
            cycles=inf if cycles is None else cycles,
            priority=priority,
            ready=lambda: click.echo(f"ready on {url}"),
        )
    except BridgeError as error:
        raise FailedError(one_line(error)) from error
    click.echo(loop.statistics)
    click.echo(f"{number(machine.time)} s simulated, {number(loop.lost)} s behind the clock")
