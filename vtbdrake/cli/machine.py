"""``vtbdrake machine``: simulate the physical robot of a scenario in a separate process."""

from __future__ import annotations

import logging
from math import inf

import click

from vtbdrake.cli import FailedError, one_line
from vtbdrake.cli.options import Setting, converted, parse_setting, scenario_argument, set_option, settings, url_option
from vtbdrake.cli.output import number
from vtbdrake.control.bridge import BridgeError
from vtbdrake.machine import Machine, MachineConfig, MachineLoop
from vtbdrake.machine.loop import epoch, serve
from vtbdrake.machine.machine import BRAKES
from vtbdrake.testbed import Scenario

_DEFAULT = MachineConfig()


def _parse_noise(text: str) -> tuple[str, float]:
    try:
        name, value = parse_setting(text)
    except click.BadParameter as error:
        raise click.BadParameter(f"expected SIGNAL=STD, a number, not {text!r}") from error
    if isinstance(value, list):
        raise click.BadParameter(f"the noise of {name} is one standard deviation for all its entries, not {value}")
    return name, value


@click.command()
@scenario_argument
@url_option
@click.option(
    "--period",
    type=float,
    default=_DEFAULT.period,
    show_default=True,
    metavar="S",
    help="The period of a cycle, in seconds; each cycle publishes the state once.",
)
@click.option("--lock-step", is_flag=True, help="Begin a cycle with a command on every channel, not by the clock.")
@click.option("--cycles", type=click.IntRange(min=0), metavar="N", help="End after N cycles.  [default: endless]")
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
    help="Add normal noise to a sensor signal, in its unit. May be repeated.",
)
@click.option(
    "--seed", type=int, default=_DEFAULT.seed, show_default=True, metavar="N", help="The seed of all random numbers."
)
@click.option(
    "--sense-latency",
    type=float,
    default=0.0,
    metavar="MS",
    help="The latency of sensor messages, in milliseconds; whole cycles.",
)
@click.option(
    "--act-latency",
    type=float,
    default=0.0,
    metavar="MS",
    help="The latency of commands, in milliseconds; whole cycles.",
)
@click.option(
    "--timeout",
    type=float,
    default=_DEFAULT.timeout,
    show_default=True,
    metavar="S",
    help="Brake after S seconds without a command.",
)
@click.option(
    "--max-latency",
    type=float,
    default=_DEFAULT.max_latency,
    show_default=True,
    metavar="S",
    help="Reject commands that took S seconds longer than the quickest one, by their sender's clock; inf rejects none. "
    "Not in lock-step.",
)
@click.option(
    "--brake",
    type=click.Choice(BRAKES),
    help="Lock the joints (default for a discrete plant), apply the idle commands (default for a continuous one) "
    "or hold the last commands.",
)
@click.option(
    "--priority",
    type=click.IntRange(0, 99),
    default=0,
    show_default=True,
    metavar="N",
    help="The priority of real-time scheduling (SCHED_FIFO), 1 to 99, if the system grants it.",
)
def machine(
    scenario: Scenario,
    url: str,
    period: float,
    lock_step: bool,
    cycles: int | None,
    values: tuple[Setting, ...],
    perturb: float,
    noise: tuple[tuple[str, float], ...],
    seed: int,
    sense_latency: float,
    act_latency: float,
    timeout: float,
    max_latency: float,
    brake: str | None,
    priority: int,
) -> None:
    """Simulate the physical robot of a scenario over LCM, until Ctrl-C.

    The method deployment() of the scenario describes the channels. VTB_MACHINE takes requests for faults as JSON, such
    as {"fault": "drop", "fraction": 0.5} or {"request": "normal"}. The status is published on VTB_MACHINE_STATUS.

    \b
    Example:
      vtbdrake machine vtbdrake_diagrams.manipulator:ManipulatorScenario --url tcpq://127.0.0.1:7700 \\
          --perturb 0.05 --seed 3
    """
    logging.basicConfig(format="%(asctime)s %(message)s", level=logging.INFO)
    config = MachineConfig(
        period=period,
        values=settings(values),
        perturb=perturb,
        noise=dict(noise),
        seed=seed,
        sense_latency=1e-3 * sense_latency,
        act_latency=1e-3 * act_latency,
        timeout=timeout,
        max_latency=max_latency,
        brake=brake or "",
    )
    simulated = Machine(scenario, config, epoch=epoch(lock_step=lock_step))
    for address, value in simulated.perturbed.items():
        click.echo(f"{address} = {value}")
    try:
        loop = MachineLoop(simulated, url)
        serve(
            loop,
            lock_step=lock_step,
            cycles=inf if cycles is None else cycles,
            priority=priority,
            ready=lambda: click.echo(f"ready on {url}"),
        )
    except BridgeError as error:
        raise FailedError(one_line(error)) from error
    click.echo(loop.statistics)
    click.echo(f"{number(simulated.time)} s simulated, {number(loop.lost)} s behind the clock")
