"""Every benchmark: ``python -m benchmarks [--page FILE] [ONLY...]``.

Prints one row each and writes the results of this run to ``benchmarks/results.json``, and to a page of the
documentation.
"""

from __future__ import annotations

from pathlib import Path

import click

from benchmarks.report import BENCHMARKS, benchmark_all, results_page, results_table, write_results
from vtbdrake_diagrams.tables import Crash

FILE = Path(__file__).with_name("results.json")


@click.command()
@click.argument("only", nargs=-1)
@click.option("--page", type=click.Path(dir_okay=False, path_type=Path), help="The page to write, docs/benchmarks.md.")
def main(only: tuple[str, ...], page: Path | None) -> None:
    """Run the benchmarks ONLY, or all but the longest, which run by name."""
    try:
        results = benchmark_all(only, registry=BENCHMARKS, echo=lambda line: click.echo(line, err=True))
    except ValueError as error:
        raise click.UsageError(str(error)) from error
    write_results(FILE, results)
    if page is not None:
        page.write_text(results_page(results, only=only), "utf-8")
    click.echo(results_table(results))
    if any(isinstance(result, Crash) for result in results):
        raise SystemExit(1)


main(prog_name="python -m benchmarks")
