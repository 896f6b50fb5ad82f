"""A study on a Dask cluster whose rollouts only wait, in a process that is going to be killed."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

from benchmarks.cluster import Waiting
from tests.optimization.studies import pendulum_problem
from vtbdrake.optimization import Study
from vtbdrake.rollout import RolloutResult

SLOTS = 40
ROLLOUTS = 160


def waiting_study(path: str | None = None) -> Study:
    """Return a study with as many points side by side as the cluster has slots."""
    return pendulum_problem().study(path, solver="cmaes", seed=3, parallel=SLOTS)


class _Telling(Waiting):
    """Prints a line for each rollout that is recorded: a study asks for the next one afterwards."""

    def run(self, *args: Any, **options: Any) -> Iterator[tuple[int, RolloutResult]]:
        for result in super().run(*args, **options):
            yield result
            print("recorded", flush=True)


def main(path: str, address: str) -> None:
    """Run the study on the cluster of a scheduler."""
    with waiting_study(path) as study, _Telling(address, duration=0.2) as executor:
        study.run(rollouts=ROLLOUTS, executor=executor, progress=False)


if __name__ == "__main__":
    main(*sys.argv[1:])
