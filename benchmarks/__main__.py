"""Every benchmark: ``python -m benchmarks [ONLY...]``.

Prints one row each and writes the results of this run to ``benchmarks/results.json``.
"""

from __future__ import annotations

from pathlib import Path

import click

from benchmarks.report import BENCHMARKS, benchmark_all, results_table, write_results
from vtbdrake_diagrams.tables import Crash

FILE = Path(__file__).with_name("results.json")


@click.command()
@click.argument("only", nargs=-1)
def main(only: tuple[str, ...]) -> None:
    """Run the benchmarks ONLY, or all."""
    try:
        results = benchmark_all(only, registry=BENCHMARKS, echo=lambda line: click.echo(line, err=True))
    except ValueError as error:
        raise click.UsageError(str(error)) from error
    write_results(FILE, results)
    click.echo(results_table(results))
    if any(isinstance(result, Crash) for result in results):
        raise SystemExit(1)


main(prog_name="python -m benchmarks")
