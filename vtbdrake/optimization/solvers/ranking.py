"""Which of two evaluations is better: Deb's rule.

What keeps the constraints is better than what does not; of two that keep them, the one of larger value; of two that do
not, the one of smaller total violation; and a failed simulation is worse than all.

Deb, K. (2000): An efficient constraint handling method for genetic algorithms. Comput. Methods Appl. Mech. Engrg. 186.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import isnan

from vtbdrake.optimization.solvers.solver import Evaluation


def usable(evaluation: Evaluation) -> bool:
    """Whether the simulation gave numbers, be they feasible or not."""
    return not evaluation.failed and not any(isnan(violation) for violation in evaluation.violations)


def total_violation(evaluation: Evaluation) -> float:
    """By how much it breaks the constraints; 0 if it keeps them."""
    return sum(max(violation, 0.0) for violation in evaluation.violations)


def rank_key(evaluation: Evaluation) -> tuple[int, float]:
    """Sorts the evaluations of one objective, the best first; what racing dropped comes after what was judged."""
    if not usable(evaluation):
        return 3, 0.0
    if not evaluation.feasible:
        return 2, total_violation(evaluation)
    return (0 if evaluation.exact else 1), -evaluation.values[0]


def best_of(evaluations: Iterable[Evaluation]) -> Evaluation | None:
    """The best of one objective; None if all failed."""
    best = min((evaluation for evaluation in evaluations if usable(evaluation)), key=rank_key, default=None)
    return best


def costs(evaluations: Sequence[Evaluation]) -> list[float]:
    """Numbers in the order of Deb's rule, smaller is better; for feasible ones, the negated value."""
    feasible = [-evaluation.values[0] for evaluation in evaluations if evaluation.feasible]
    floor = max(feasible, default=0.0)
    broken = [total_violation(evaluation) for evaluation in evaluations if usable(evaluation)]
    worst = floor + max(broken, default=0.0) + 1.0
    return [
        worst
        if not usable(evaluation)
        else -evaluation.values[0]
        if evaluation.feasible
        else floor + total_violation(evaluation)
        for evaluation in evaluations
    ]
