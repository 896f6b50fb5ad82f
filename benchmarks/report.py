"""The list of all benchmarks, and the table of their results."""

from __future__ import annotations

import os
import platform
import re
import textwrap
import time
from collections.abc import Callable, Sequence
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import Any

from benchmarks.measure import Benchmark
from vtbdrake.cli.output import number, table
from vtbdrake_diagrams.tables import Crash, Registry, run, selected_names, write_json

# Name -> function () -> Benchmark or list of them; the first bears the name, the others are printed beside it.
BENCHMARKS: Registry = {
    "import_time": "benchmarks.import_time:import_time",
    "testbed_overhead": "benchmarks.space_climber:testbed_overhead",
    "station_overhead": "benchmarks.station:station_overhead",
    "sweep_speedup": "benchmarks.space_climber:sweep_speedup",
    "rollout_rtf": "benchmarks.space_climber:rollout_rtf",
    "rollout_ladder": "benchmarks.ladder:rollout_ladder",
    "rollout_ladder_climber": "benchmarks.ladder:rollout_ladder_climber",
    "parallel_efficiency_cpp": "benchmarks.parallel:parallel_efficiency_cpp",
    "parallel_efficiency_python": "benchmarks.parallel:parallel_efficiency_python",
    "cluster_projection": "benchmarks.cluster:cluster_projection",
    "casadi_system": "benchmarks.casadi_system:casadi_system",
    "policy_cycle": "benchmarks.policy:policy_cycle",
    "image_switch": "benchmarks.image_switch:image_switch",
    "decision_overhead": "benchmarks.decision:decision_overhead",
    "decision_overhead_compiled": "benchmarks.decision:decision_overhead_compiled",
    "predictive_sampling": "benchmarks.predictive_sampling:predictive_sampling",
    "predictive_sampling_testbed": "benchmarks.predictive_sampling:predictive_sampling_testbed",
    "compiled_contact_quadruped": "benchmarks.compiled_contact:compiled_contact",
    "legged_replanning": "benchmarks.legged_replanning:legged_replanning",
    "compiled_contact_climber": "benchmarks.compiled_contact:compiled_contact_climber",
    "compiled_testbed": "benchmarks.compiled_testbed:compiled_testbed",
    "compile_time": "benchmarks.compiled_testbed:compile_time",
    "hub_round_trip_p50": "benchmarks.hub:hub_round_trip_p50",
    "loop_state_to_command_p50": "benchmarks.loop:loop_state_to_command_p50",
    "loop_misses": "benchmarks.loop:loop_misses",
    "cycle_overhead": "benchmarks.loop:cycle_overhead",
    "loop_against_drake": "benchmarks.loop:loop_against_drake",
    "slow_part_misses": "benchmarks.slow_part:slow_part_misses",
    "loop_p99_beside_reasoner": "benchmarks.onboard:loop_p99_beside_reasoner",
    "recording_cost": "benchmarks.recording:recording_cost",
    "replay_cost": "benchmarks.recording:replay_cost",
    "payload_alarm": "benchmarks.residuals:payload_alarm",
    "read_table_csv": "benchmarks.tables:read_table_csv",
    "read_table_parquet": "benchmarks.tables:read_table_parquet",
    "log_replay": "benchmarks.compiled_testbed:log_replay",
    "gymnasium_step": "benchmarks.environments:gymnasium_step",
    "gymnasium_vector_compiled": "benchmarks.environments:gymnasium_vector_compiled",
    "seeds_varied": "benchmarks.compiled_testbed:seeds_varied",
    "calibration_time": "benchmarks.calibration:calibration_time",
    "domain_query": "benchmarks.domain_query:domain_query",
    "dps_alone_start": "benchmarks.dps_alone:dps_alone_start",
    "study_overhead_threads": "benchmarks.study:study_overhead_threads",
    "study_overhead_processes": "benchmarks.study:study_overhead_processes",
    "study_against_optuna": "benchmarks.study:study_against_optuna",
    "auto_regret": "benchmarks.auto_regret:auto_regret",
    "auto_regret_full": "benchmarks.auto_regret:auto_regret_full",
    "auto_regret_tuning": "benchmarks.auto_regret:auto_regret_tuning",
    "auto_regret_mixed": "benchmarks.auto_regret:auto_regret_mixed",
    "racing_savings": "benchmarks.study:racing_savings",
    "study_page_open": "benchmarks.study_page:study_page_open",
    "study_page_cost": "benchmarks.study_page:study_page_cost",
    "camera_study_speedup": "benchmarks.camera_study:camera_study_speedup",
    "time_to_target": "benchmarks.gait:time_to_target",
    "time_to_target_full": "benchmarks.gait:time_to_target_full",
    "capture_ladder": "benchmarks.ladder:capture_ladder",
    "capture_rtf_images": "benchmarks.satellite:capture_rtf_images",
    "arm_trajectory": "benchmarks.arm_trajectory:arm_trajectory",
    "crater_decision": "benchmarks.crater:crater_decision",
    "scanner_cost": "benchmarks.scanner:scanner_cost",
    "vr_pose_to_command": "benchmarks.vr:vr_pose_to_command",
    "view_cost": "benchmarks.view:view_cost",
    "view_states": "benchmarks.view:view_states",
    "click_p95": "benchmarks.view:click_p95",
    "preview_latency": "benchmarks.view:preview_latency",
    "localization_update_p50": "benchmarks.localization:localization_update_p50",
    "growth_sweep": "benchmarks.growth:growth_sweep",
    "growth_study_append": "benchmarks.growth:growth_study_append",
    "growth_log_open": "benchmarks.growth:growth_log_open",
    "growth_testbed_systems": "benchmarks.growth:growth_testbed_systems",
    "growth_recorded_variables": "benchmarks.growth:growth_recorded_variables",
    "growth_campaign": "benchmarks.growth:growth_campaign",
    "first_picture": "benchmarks.first_picture:first_picture",
    "bare_to_browser": "benchmarks.first_picture:bare_to_browser",
}

# They take minutes each, or need a wheel; without names, the others run.
ONLY_BY_NAME = ("calibration_time", "auto_regret_full", "auto_regret_tuning", "time_to_target_full", "bare_to_browser")

FIELDS = ("name", "value", "unit", "goal", "better", "holds", "against")

_VERDICTS = {True: "yes", False: "NO", None: ""}
_SIGNS = {"higher": ">=", "lower": "<="}


def benchmark_all(
    only: Sequence[str] = (), *, registry: Registry = BENCHMARKS, echo: Callable[[str], Any] = print
) -> list[Benchmark | Crash]:
    """Run the named benchmarks, or all but `ONLY_BY_NAME`. One that raises becomes a `Crash`, and the others still run.

    Raises:
        ValueError: A name is unknown.
    """
    results: list[Benchmark | Crash] = []
    start = time.monotonic()
    for name in selected_names(registry, only):
        if not only and name in ONLY_BY_NAME:
            continue
        begin = time.monotonic()
        outcome = run(registry, name)
        echo(f"{name}: measured in {time.monotonic() - begin:.0f} s")
        results += outcome if isinstance(outcome, list) else [outcome]
    echo(f"all of them: {(time.monotonic() - start) / 60.0:.1f} min")
    return results


def results_table(results: Sequence[Benchmark | Crash]) -> str:
    """One row each, and the notes below."""
    header = ("benchmark", "value", "unit", "goal", "holds", "against")
    rows = [_crash_row(r) if isinstance(r, Crash) else _row(r) for r in results]
    notes = [f"{r.name}: {_notes(r)}" for r in results if isinstance(r, Benchmark) and _notes(r)]
    return "\n".join([table(header, rows), *notes])


_PAGE = """\
# Benchmarks

`make bench` measures every claim of speed as a ratio: what is compared runs in turns in one run, so that a slower
machine changes both. Goals in a unit stand for a limit of people or of machines, which their notes name; they presume
a machine like this one. Other load spoils ratios of some per cent, and everything about real time. Rows that take
minutes run only by name: {by_name}. `make bench PAGE=1` writes this page{only}.

Measured on {date}: {machine}.

| benchmark | value | unit | goal | holds | measured beside |
|---|---|---|---|---|---|
{rows}

{notes}
"""


def results_page(results: Sequence[Benchmark | Crash], *, only: Sequence[str] = ()) -> str:
    """Return docs/benchmarks.md: the table in Markdown, with machine and date."""
    rows = [_crash_row(r) if isinstance(r, Crash) else _row(r) for r in results]
    notes = [
        textwrap.fill(f"* {r.name}: {_notes(r)}", 120, subsequent_indent="  ", break_on_hyphens=False)
        for r in results
        if isinstance(r, Benchmark) and _notes(r)
    ]
    return _PAGE.format(
        by_name=", ".join(f"`{name}`" for name in ONLY_BY_NAME),
        only=f"; this one has only the rows of\n`ONLY='{' '.join(only)}'`" if only else "",
        date=date.today().isoformat(),
        machine=machine(),
        rows="\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |" for row in rows),
        notes="\n".join(notes),
    )


def machine() -> str:
    """Return processor, load and versions, in words."""
    model = re.search(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text("utf-8"), re.MULTILINE)
    return (
        f"{len(os.sched_getaffinity(0))} cores of {model[1] if model else platform.machine()}, with a load of "
        f"{os.getloadavg()[2]:.1f} processes (mean of 15 minutes), Python {platform.python_version()}, "
        f"drake {version('drake')}"
    )


def _row(result: Benchmark) -> tuple[str, ...]:
    goal = "" if result.goal is None else f"{_SIGNS[result.better]} {number(result.goal)}"
    unit = "" if result.unit == "1" else result.unit
    return (result.name, f"{result.value:.4g}", unit, goal, _VERDICTS[result.holds], result.against)


def _notes(result: Benchmark) -> str:
    absolute = f"absolute: {result.absolute}" if result.absolute else ""
    return "; ".join(filter(None, (result.note, absolute)))


def _crash_row(crash: Crash) -> tuple[str, ...]:
    return (crash.name, "-", "", "", "NO", str(crash))


def write_results(path: Path, results: Sequence[Benchmark | Crash]) -> None:
    """Write the results with the fields `FIELDS`; a crash has no value, and does not hold."""
    write_json(path, [_fields(result) for result in results])


def _fields(result: Benchmark | Crash) -> dict[str, Any]:
    if isinstance(result, Crash):
        return {**dict.fromkeys(FIELDS), "name": result.name, "holds": False}
    return {name: getattr(result, name) for name in FIELDS}
