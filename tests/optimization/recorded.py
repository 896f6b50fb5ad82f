"""Studies whose points are stated, not simulated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from math import nan
from pathlib import Path
from typing import Any

from vtbdrake.optimization import Study, Trial
from vtbdrake.optimization.parameter import Dimension
from vtbdrake.optimization.study.study_file import StudyFile


def point(
    at: Sequence[Any],
    *values: float,
    violations: Sequence[float] = (),
    exact: bool = True,
    method: str = "TPE",
) -> Mapping[str, Any]:
    """Return an evaluated point; without values, one that failed."""
    return {"at": tuple(at), "values": values, "violations": tuple(violations), "exact": exact, "method": method}


def recorded(
    parameters: Sequence[Dimension],
    points: Sequence[Mapping[str, Any]],
    *,
    qualities: Mapping[str, str],
    units: Sequence[str] | None = None,
    conditions: int = 1,
    risk: str = "Worst()",
    path: Path | None = None,
) -> Study:
    """A study with these points, each in a batch of its own, and no rollouts.

    Args:
        qualities: name -> ``maximize`` or ``minimize``.
        path: Path of its file; None keeps it in memory.
    """
    problem = {
        "parameters": [asdict(parameter) for parameter in parameters],
        "qualities": [{"name": name, "minimize": direction == "minimize"} for name, direction in qualities.items()],
        "constraints": [],
        "conditions": [{}] * conditions,
        "risk": risk,
    }
    units = [""] * len(parameters) if units is None else list(units)
    meta = {"problem": problem, "solver": "TPE", "seed": 0, "options": {}, "units": units}
    meta |= {"limits": [None] * len(units), "versions": {}, "revision": None}
    file = StudyFile(path, meta=meta)
    for batch, made in enumerate(points):
        trial = Trial(
            parameters=dict(zip((parameter.address for parameter in parameters), made["at"], strict=True)),
            values=made["values"] or (nan,) * len(qualities),
            violations=made["violations"],
            exact=made["exact"],
            origin="solver",
            method=made["method"],
            batch=batch,
        )
        file.save_trials(batch, {0: trial}, complete=True)
    return Study(file)
