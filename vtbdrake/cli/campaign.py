"""``vtbdrake campaign``: run the campaign of a file, and report what it shows."""

from __future__ import annotations

import logging
import shlex
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vtbdrake.cli import FailedError
from vtbdrake.cli.options import grouped, option, schema_option
from vtbdrake.cli.output import emit, json_option, number, save_recording, say, table, write_whole
from vtbdrake.cli.problem import executor_options, on_error_option
from vtbdrake.common.failures import one_line
from vtbdrake.common.file_names import as_file_name

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat

    from vtbdrake.campaigns.campaign import Campaign, Rerun
    from vtbdrake.campaigns.report import Evidence
    from vtbdrake.campaigns.results import CampaignResult, CampaignRollout, Cell, PairedComparison

# The files in the folder of a campaign.
STUDY = "study.db"
PAGE = "index.html"
JUNIT = "junit.xml"
RESULTS = "results.json"
_MOST_EVIDENCE = 20
"""The number of failed rollouts that are run again for their logs and animations, at most."""


def _parse_rollout(text: str) -> tuple[str, int]:
    condition, _, seed = text.rpartition("/")
    if not condition or not seed.isdecimal():
        raise click.BadParameter(f"expected CONDITION/SEED, such as heavy/7, not {text!r}")
    return condition, int(seed)


def _schema() -> dict[str, Any]:
    from vtbdrake.campaigns.campaign import Campaign

    return Campaign.schema()


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@option("--folder FOLDER", "Where study and reports lie.  [default: FILE without its suffix]", type=Path)
@option(
    "--against OTHER",
    "Compare with a baseline: the file of a campaign with the same conditions, seeds and criteria, which is run, too; "
    "or the study.db of one.",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
)
@option("--rollout CONDITION/SEED", "Run this rollout alone, with log and animation.", parse=_parse_rollout)
@option(
    "--evidence/--no-evidence", "Run the first failure of each cell again, for its log and animation.", default=True
)
@executor_options
@grouped(
    "running",
    option("--seconds S", "End after S seconds of wall time; the same command resumes the campaign.", type=float),
    option("--time-limit S", "Fail a rollout that takes longer than S seconds.", type=float),
    option("--allow-changed-code", "Resume although the code has changed.", is_flag=True),
)
@on_error_option
@schema_option(_schema)
@json_option
def campaign(
    file: Path,
    folder: Path | None,
    against: Path | None,
    rollout: tuple[str, int] | None,
    evidence: bool,
    running: dict[str, Any],
) -> None:
    """Run the campaign of FILE: how often does it work?

    All conditions are simulated with all seeds, and judged by the criteria. Rollouts are recorded in a study, so that
    the same command resumes a campaign that was interrupted or killed, or that has got more seeds. The folder gets
    index.html, junit.xml, results.json, and of failures logs and animations. FILE names functions and a scenario, whose
    code is run.

    The exit code is 0 if all criteria are met, 1 if not, 2 if the input cannot be used.

    \b
    Example:
      vtbdrake campaign walking.yaml --workers 4 --against baseline.yaml
    """
    from vtbdrake.campaigns.campaign import Campaign
    from vtbdrake.campaigns.report import html_page, junit_xml
    from vtbdrake.campaigns.results import MET

    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    stated = Campaign.load(file)
    folder = file.with_suffix("") if folder is None else folder
    if folder.exists() and not folder.is_dir():
        raise click.UsageError(f"{folder} is no folder: give another one by --folder")
    if rollout is not None:
        _run_alone(stated, rollout, folder)
        return
    baseline = None if against is None else _baseline(stated, against, running)
    folder.mkdir(parents=True, exist_ok=True)
    result = stated.run(folder / STUDY, **running)
    comparisons = [] if baseline is None else result.compare(baseline)
    commands = {each.name: _command(file, folder, each.name) for each in result.rollouts}
    kept = _gather_evidence(result, folder, **running) if evidence else {}
    page = html_page(result, commands=commands, evidence=kept, comparisons=comparisons, baseline=str(against))
    write_whole(folder / PAGE, page.encode())
    write_whole(folder / JUNIT, junit_xml(result, commands).encode())
    write_whole(folder / RESULTS, result.to_json(comparisons=comparisons).encode())
    _print(result, commands, comparisons, folder)
    emit(result.to_dict(comparisons=comparisons))
    if not result.is_complete:
        raise FailedError("not all rollouts were run: the same command resumes the campaign")
    if not result.is_met:
        judged = [cell for cell in result.cells() if cell.is_judged]
        missed = sum(cell.verdict != MET for cell in judged)
        raise FailedError(f"{missed} of {len(judged)} requirements are not met: see {folder / PAGE}")


def _command(file: Path, folder: Path, name: str) -> str:
    """Return the command that runs a rollout alone."""
    elsewhere = [] if folder == file.with_suffix("") else ["--folder", str(folder)]
    return shlex.join(["vtbdrake", "campaign", str(file), *elsewhere, "--rollout", name])


def _baseline(stated: Campaign, against: Path, running: dict[str, Any]) -> CampaignResult:
    from vtbdrake.campaigns.campaign import Campaign

    if against.suffix not in (".yaml", ".yml"):
        return stated.baseline(against)
    other = Campaign.load(against)
    other_folder = against.with_suffix("")
    stated.check_pairs(other)
    other_folder.mkdir(parents=True, exist_ok=True)
    other.run(other_folder / STUDY, **running)
    return stated.baseline(other_folder / STUDY)


def _gather_evidence(
    result: CampaignResult, folder: Path, *, executor: str, time_limit: float | None, **_: Any
) -> dict[str, Evidence]:
    """Run the first failure of each cell again; write log and animation."""
    from vtbdrake.campaigns.report import failed_cells
    from vtbdrake.campaigns.results import ERROR, FAIL
    from vtbdrake.optimization.sweep import borrowed

    firsts = {cell.having(FAIL, ERROR)[0].name: cell.having(FAIL, ERROR)[0] for cell in failed_cells(result)}
    kept: dict[str, Evidence] = {}
    if not firsts:
        return kept
    # A rollout that has killed its process, or that never ends, does so again: not in this process.
    where = "serial" if executor in ("serial", "threads") else "processes"
    with borrowed(result.campaign.problem, where, rollouts=1, time_limit=time_limit) as opened:
        for rollout in list(firsts.values())[:_MOST_EVIDENCE]:
            rerun = result.campaign.run_again(rollout.condition, rollout.seed, executor=opened)
            kept[rollout.name] = _written(result.campaign, rollout, rerun, folder)
    return kept


@cache
def _meshcat() -> Meshcat:
    """Return the server in which all motions are drawn, one after the other."""
    from vtbdrake.visualization import make_meshcat

    return make_meshcat()


def _written(stated: Campaign, rollout: CampaignRollout, rerun: Rerun, folder: Path) -> Evidence:
    """Write log and animation of a rollout that was run again, and return what there is of it."""
    from vtbdrake.campaigns.report import Evidence

    index = stated.rollout_names.index((rollout.condition, rollout.seed))
    stem = f"{index}-{as_file_name(rollout.condition)}-{rollout.seed}"
    notes, log, animation = [], "", ""
    if rollout.end and rerun.rollout != rollout:
        notes.append("It did not repeat: alone it has other numbers than in the campaign.")
    numeric = {address: values for address, values in rerun.result.record.items() if hasattr(values, "dtype")}
    if len(rerun.result.times):
        log = f"{stem}.npz"
        save_recording(folder / log, rerun.result.times, numeric)
    if rerun.motion is not None:
        from vtbdrake.visualization import show_motion

        try:
            show_motion(_meshcat(), rerun.motion).save(folder / f"{stem}.html", shared=True)
            animation = f"{stem}.html"
        except ValueError as error:  # There is nothing to draw.
            notes.append(f"There is no animation: {one_line(error)}.")
    return Evidence(rerun, log, animation, " ".join(notes))


def _run_alone(stated: Campaign, name: tuple[str, int], folder: Path) -> None:
    from vtbdrake.campaigns.report import limits_text, reason
    from vtbdrake.campaigns.results import ERROR, FAIL, Cell

    rerun = stated.run_again(*name)
    folder.mkdir(parents=True, exist_ok=True)
    kept = _written(stated, rerun.rollout, rerun, folder)
    rows, wrong = [], 0
    for criterion_name, criterion in stated.criteria.items():
        cell = Cell(criterion_name, criterion, rerun.rollout.condition, (rerun.rollout,))
        (status,) = cell.statuses
        wrong += criterion.is_limited and status in (FAIL, ERROR)
        time = rerun.first_violation(criterion_name, criterion)
        value = "" if status == ERROR else reason(cell, rerun.rollout)
        since = "" if time is None else f"{number(time)} s"
        rows.append((criterion_name, limits_text(criterion), value, status if criterion.is_limited else "", since))
    say(table(("criterion", "limit", "number", "", "violated from"), rows))
    files = [str(folder / name) for name in (kept.log, kept.animation) if name]
    say("\n".join(["", *files, kept.note]).rstrip())
    titles = ("criterion", "limit", "number", "status", "violated_from")
    criteria = [dict(zip(titles, row, strict=True)) for row in rows]
    emit({"rollout": rerun.rollout, "criteria": criteria, "files": files, "note": kept.note})
    if rerun.result.failed:
        raise FailedError(f"the rollout failed: {one_line(rerun.result.message)}")
    if wrong:
        raise FailedError(f"{rerun.rollout.name} does not pass {wrong} of {len(stated.criteria)} criteria")


def _print(result: CampaignResult, commands: dict[str, str], comparisons: list[PairedComparison], folder: Path) -> None:
    from vtbdrake.campaigns.report import failed_cells, passed_text, reason, warning
    from vtbdrake.campaigns.results import ALL, COMPARED, ERROR, FAIL

    criteria = list(result.campaign.criteria)
    rows = []
    for condition in [*result.campaign.conditions, ALL]:
        cells = [result.cell(condition, name) for name in criteria]
        rows.append([condition, *("" if cell is None else _with_verdict(cell) for cell in cells)])
    say(table(["condition", *criteria], rows))
    for cell in failed_cells(result):
        first = cell.having(FAIL, ERROR)[0]
        say(f"\n{cell.condition}, {cell.name}: {first.name}: {reason(cell, first)}\n  {commands[first.name]}")
    if comparisons:
        say("\n" + table(COMPARED, [comparison.row for comparison in comparisons]))
    if caution := warning(result):
        say(f"\nWarning: {caution}")
    say(f"\n{passed_text(result)}: {folder / PAGE}")


def _with_verdict(cell: Cell) -> str:
    from vtbdrake.campaigns.report import cell_text
    from vtbdrake.campaigns.results import MET

    mark = f" {cell.verdict}" if cell.is_judged and cell.verdict != MET else ""
    return cell_text(cell) + mark
