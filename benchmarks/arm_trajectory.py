"""Plans of the satellite's arm: how long solvers take for one, and the momentum model beside the full testbed."""

from __future__ import annotations

import time
from collections.abc import Callable
from math import inf

import numpy as np

from benchmarks.measure import LOWER, Benchmark, interleaved, ratio
from vtbdrake.optimization import Study
from vtbdrake.optimization.records import Trial
from vtbdrake_diagrams.satellite.arm_move import RESTING
from vtbdrake_diagrams.satellite.arm_planning import Plan, plan_by_casadi, plan_by_drake
from vtbdrake_diagrams.satellite.studies.arm_motion import ArmMotionScenario
from vtbdrake_diagrams.satellite.studies.trajectory import search_problem

# Target of the deviation at the end, in rad.
TARGET = np.radians(1.0)
SCENARIO = ArmMotionScenario(thinking_time=0.2)
# First standard deviation of CMA-ES, as a part of the ranges.
_SPREAD = 0.1
SOLVERS: dict[str, Callable[..., Plan]] = {
    "casadi_ipopt": plan_by_casadi,
    "snopt": lambda move: plan_by_drake(move, "SNOPT"),
    "ipopt": lambda move: plan_by_drake(move, "IPOPT"),
}


def arm_trajectory(repeats: int = 10, searched: int = 30) -> list[Benchmark]:
    """Time of the momentum model beside a rollout's, and times to 1 deg by solver.

    Args:
        repeats: Rollouts that are measured.
        searched: Rollouts of black-box search in the full testbed.
    """
    move, problem = SCENARIO.move(), search_problem(SCENARIO)
    point = dict(
        zip(
            [parameter.address for parameter in problem.parameters],
            move.straight[RESTING:-RESTING].ravel(),
            strict=True,
        )
    )
    model, rollout = interleaved(
        lambda: move.motion(move.straight), lambda: problem.rollout(point), repeats=repeats, warm_up=1
    )
    straight = np.degrees(move.motion(move.straight).angle[-1])
    rows = [
        Benchmark(
            name="arm_trajectory",
            value=ratio(model, rollout),
            unit="1",
            goal=1.0 / 500.0,
            better=LOWER,
            against=f"a rollout of {SCENARIO.horizon:g} s in the full testbed",
            note=f"{1e3 * np.median(model):.2f} ms by the momentum model, torques included, "
            f"{1e3 * np.median(rollout):.0f} ms by the rollout; n = {repeats}",
        )
    ]
    for name, solve in SOLVERS.items():
        begin = time.perf_counter()
        plan = solve(move)
        rows.append(_row(name, plan, time.perf_counter() - begin, straight))
    # It is told of the straight path, but does not begin there.
    begin, history = time.perf_counter(), [(0.0, inf)]
    study = problem.study(solver="CMA-ES", options={"sigma": _SPREAD})
    study.add(point)

    def look(_: Study, trial: Trial) -> None:
        if max(trial.violations) <= 0.0 and trial.value < history[-1][1]:
            history.append((time.perf_counter() - begin, trial.value))

    study.run(rollouts=searched, executor="serial", callbacks=[look], progress=False)
    plan = Plan(move, move.straight, history[-1][1], tuple(history), "")
    rows.append(_row("cma_es_testbed", plan, time.perf_counter() - begin, straight))
    return rows


def _row(name: str, plan: Plan, seconds: float, straight: float) -> Benchmark:
    return Benchmark(
        name=f"arm_trajectory_{name}",
        value=plan.time_to(TARGET),
        unit="s",
        goal=None,
        better=LOWER,
        against="wall time to 1 deg",
        note=f"{np.degrees(plan.deviation):.4f} deg after {seconds:.1f} s, {straight:.2f} on the straight path",
    )
