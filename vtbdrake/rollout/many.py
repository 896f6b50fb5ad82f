"""Many rollouts with a progress bar; an interruption keeps what is finished."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence

from tqdm.auto import tqdm

from vtbdrake.rollout.executor import Executor, Parameters
from vtbdrake.rollout.result import RolloutResult
from vtbdrake.rollout.task import RolloutTask
from vtbdrake.testbed.interrupt import Interruptible

_log = logging.getLogger(__name__)


def run_rollouts(
    executor: Executor,
    task: RolloutTask,
    points: Sequence[Parameters],
    *,
    progress: bool = True,
    description: str = "rollouts",
) -> list[RolloutResult | None]:
    """One result per point, in the order of ``points``.

    Ctrl-C ends the rollouts that run and hands out no more; the list then has None where there is no result.

    Raises:
        QualityError: f raises, is negative or NaN.
    """
    results: list[RolloutResult | None] = [None] * len(points)
    with tqdm(total=len(points), desc=description, unit="rollout", disable=not (progress and watched())) as bar:
        rollouts = executor.run(task, points)
        try:
            with Interruptible() as interruptible:
                for index, result in rollouts:
                    results[index] = result
                    bar.update()
                    interruptible.check()
        except KeyboardInterrupt:
            done = sum(result is not None for result in results)
            _log.warning("interrupted: %d of %d rollouts are finished and kept", done, len(points))
        finally:
            rollouts.close()  # type: ignore[attr-defined]
    return results


def watched() -> bool:
    """True in a terminal and in a notebook."""
    return sys.stderr.isatty() or "ipykernel" in sys.modules
