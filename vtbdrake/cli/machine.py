"""``vtbdrake machine``: simulate the physical robot of a scenario in a separate process."""

from __future__ import annotations

import logging
from math import inf
from typing import TYPE_CHECKING, Any

import click

from vtbdrake.cli.options import (
    Setting,
    config_option,
    option,
    parse_setting,
    scenario_argument,
    set_option,
    settings,
    url_option,
)
from vtbdrake.cli.output import emit, json_option, number, say, show
from vtbdrake.common.interrupt import interrupt_taken
from vtbdrake.machine.config import BRAKES, MachineConfig

if TYPE_CHECKING:
    from vtbdrake.testbed import Scenario

_DEFAULT = MachineConfig()


def parse_deviation(text: str) -> tuple[str, float]:
    """Parse ``SIGNAL=STD``, a standard deviation of a signal."""
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
@config_option(_DEFAULT, "--period S")
@option("--lock-step", "Begin a cycle with a command on every channel, not by the clock.", is_flag=True)
@option("--cycles N", "End after N cycles.  [default: endless]", type=click.IntRange(min=0))
@set_option
@config_option(_DEFAULT, "--perturb R")
@config_option(
    _DEFAULT,
    "--noise SIGNAL=STD",
    "Add normal noise to a sensor signal, in its unit. May be repeated.",
    parse=parse_deviation,
    multiple=True,
)
@config_option(
    _DEFAULT,
    "--disturbance SIGNAL=STD",
    "Add a correlated disturbance to what acts on an actuator, in its unit. May be repeated.",
    parse=parse_deviation,
    multiple=True,
)
@config_option(_DEFAULT, "--disturbance-time S")
@config_option(_DEFAULT, "--seed N")
@option("--sense-latency MS", "The latency of sensor messages, in milliseconds; whole cycles.", default=0.0)
@option("--act-latency MS", "The latency of commands, in milliseconds; whole cycles.", default=0.0)
@config_option(_DEFAULT, "--timeout S")
@config_option(_DEFAULT, "--max-latency S")
@config_option(_DEFAULT, "--brake", type=click.Choice(BRAKES), default=None)
@option(
    "--priority N",
    "The priority of real-time scheduling (SCHED_FIFO), 1 to 99, if the system grants it.",
    type=click.IntRange(0, 99),
    default=0,
)
@json_option
def machine(
    scenario: Scenario,
    url: str,
    lock_step: bool,
    cycles: int | None,
    values: tuple[Setting, ...],
    noise: tuple[tuple[str, float], ...],
    disturbance: tuple[tuple[str, float], ...],
    sense_latency: float,
    act_latency: float,
    brake: str | None,
    priority: int,
    **fields: Any,
) -> None:
    """Simulate the physical robot of a scenario over LCM.

    It runs until Ctrl-C. The method deployment() of the scenario describes the channels. VTB_MACHINE takes requests for
    faults as JSON, such as {"fault": "drop", "fraction": 0.5} or {"request": "normal"}. The status is published on
    VTB_MACHINE_STATUS.

    \b
    Example:
      vtbdrake machine manipulator --url tcpq://127.0.0.1:7700 \\
          --perturb 0.05 --seed 3
    """
    from vtbdrake.machine import Machine, MachineLoop
    from vtbdrake.machine.machine_loop import epoch, serve

    logging.basicConfig(format="%(asctime)s %(message)s", level=logging.INFO)
    config = MachineConfig(
        values=settings(values),
        noise=dict(noise),
        disturbance=dict(disturbance),
        sense_latency=1e-3 * sense_latency,
        act_latency=1e-3 * act_latency,
        brake=brake or "",
        **fields,
    )
    simulated = Machine(scenario, config, epoch=epoch(lock_step=lock_step))
    for address, value in simulated.perturbed.items():
        say(f"{address} = {value}")
    loop = MachineLoop(simulated, url)
    serve(
        loop,
        lock_step=lock_step,
        cycles=inf if cycles is None else cycles,
        priority=priority,
        ready=lambda: show(f"ready on {url}", {"url": url, "perturbed": simulated.perturbed}),
    )
    interrupt_taken()
    say(loop.statistics)
    say(f"{number(simulated.time)} s simulated, {number(loop.lost)} s behind the clock")
    emit({"simulated": simulated.time, "lost": loop.lost, "statistics": loop.statistics.to_dict()})
