"""A study on a Dask cluster whose rollouts only wait, in a process that is going to be killed."""

from __future__ import annotations

import sys

from benchmarks.cluster import Waiting
from tests.optimization.studies import pendulum_problem
from vtbdrake.optimization import Study
from vtbdrake.optimization.records import Trial

SLOTS, ROLLOUTS = 100, 500


def waiting_study(path: str | None = None) -> Study:
    """Return a study of so many points side by side as the cluster has slots."""
    return pendulum_problem().study(path, solver="cmaes", seed=3, parallel=SLOTS)


def main(path: str, address: str) -> None:
    """Run the study on the cluster of a scheduler, and print the number of each trial that is recorded."""
    with waiting_study(path) as study, Waiting(address, duration=0.2) as executor:
        study.run(rollouts=ROLLOUTS, executor=executor, progress=False, callbacks=[_print])


def _print(_: Study, trial: Trial) -> None:
    print(trial.number, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
