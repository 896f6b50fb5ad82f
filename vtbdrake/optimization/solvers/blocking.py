"""Solvers that call the function themselves, adapted to ask and tell by a thread."""

from __future__ import annotations

import logging
import threading
from abc import abstractmethod
from collections.abc import Callable, Sequence
from queue import SimpleQueue
from typing import ParamSpec, TypeVar

import numpy as np

from vtbdrake.common.failures import error_text
from vtbdrake.optimization.solvers.solver import Evaluation, Point, Search, Solver

_log = logging.getLogger(__name__)

# A method that asks so often in a row for known points only is ended.
CIRCLES = 10_000

P = ParamSpec("P")
R = TypeVar("R")


class Stopped(Exception):  # noqa: N818
    """An exception that ends a closed solver from within its callback."""


class BlockingSolver(Solver):
    """A method that runs from start to end in one call (`_solve`), in a separate thread.

    Method and driver take turns, so that the points asked for do not depend on timing. When the solver is closed
    early, the callback raises `Stopped`, which SNOPT, IPOPT, NLopt and SciPy all survive: they clean up and return, and
    the thread is joined. A method that does not return within `grace` seconds stays behind in its daemon thread; so
    does one that is computing when the time of its run is over, after `late_grace` seconds. A method that asks
    `CIRCLES` times in a row for known points only is ended, without success.

    These methods need a number for every point. A failed simulation counts as worse than the worst point so far, by the
    spread of the values so far (at least 1). So does a point without any bound that racing dropped. Points given by
    hand are ignored.
    """

    # In seconds. Most methods end within milliseconds when they are closed, a few after thousands of calls.
    grace = 10.0
    # In seconds, beyond a budget of time that has been spent while the method computes.
    late_grace = 1.0

    def __init__(self, search: Search, *, name: str) -> None:
        super().__init__(search, name=name)
        self._requests: SimpleQueue[list[Point] | tuple[bool, str] | BaseException] = SimpleQueue()
        self._answers: SimpleQueue[Sequence[Evaluation] | None] = SimpleQueue()
        self._thread: threading.Thread | None = None
        self._stopping = False
        self._asking = False
        self._circling = 0
        self._error: BaseException | None = None
        # By the bytes of the place in the unit cube.
        self._answered: dict[bytes, tuple[Evaluation, float, np.ndarray]] = {}
        self._lowest, self._highest = np.inf, -np.inf
        self._broken = np.ones(search.constraints)

    @abstractmethod
    def _solve(self) -> tuple[bool, str]:
        """Run the method, in its thread; return whether it converged, and how it ended."""

    # -- in the method's thread

    def _evaluate(self, U: np.ndarray) -> None:
        """Have the unknown ones among points of the unit cube, shape (k, n), evaluated as one batch."""
        new = list({u.tobytes(): u for u in U if u.tobytes() not in self._answered}.values())
        self._circling = 0 if new else self._circling + 1
        if self._circling >= CIRCLES:
            self._stopping = True
        if self._stopping:
            raise Stopped
        if not new:
            return
        for u, evaluation in zip(new, self._request([self.search.point(u) for u in new]), strict=True):
            self._answered[u.tobytes()] = (evaluation, *self._numbers(evaluation))

    def _request(self, points: list[Point]) -> Sequence[Evaluation]:
        self._requests.put(points)
        answer = self._answers.get()
        if answer is None:
            raise Stopped
        return answer

    def _numbers(self, evaluation: Evaluation) -> tuple[float, np.ndarray]:
        """Return the cost and the violations that the method sees."""
        violations = self._broken
        if evaluation.usable:
            cost, violations = -evaluation.values[0], np.array(evaluation.violations)
            self._broken = np.maximum(self._broken, violations)
            if np.isfinite(cost):
                self._lowest, self._highest = min(self._lowest, cost), max(self._highest, cost)
                return cost, violations
        if self._lowest > self._highest:
            return 1.0, violations
        return self._highest + max(self._highest - self._lowest, 1.0), violations

    def _at(self, u: np.ndarray) -> tuple[Evaluation, float, np.ndarray]:
        """Return the evaluation at ``u``, shape (n,), and its cost and violations, shape (constraints,)."""
        self._evaluate(u[np.newaxis])
        return self._answered[u.tobytes()]

    def _callback(self, function: Callable[P, R]) -> Callable[P, R]:
        """Wrap a function to keep its exceptions: some libraries swallow or wrap them."""

        def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
            try:
                return function(*args, **kwargs)
            except BaseException as error:
                self._error = self._error or error
                raise

        return wrapped

    def _run(self) -> None:
        outcome: tuple[bool, str] | BaseException
        try:
            outcome = self._solve()
        except BaseException as error:
            outcome = error
        if self._circling >= CIRCLES:
            outcome = (False, f"it asked {CIRCLES} times in a row for known points only")
        elif self._error is not None:
            outcome = self._error
        self._requests.put(outcome)

    # -- in the driver's thread

    def _next(self) -> list[Point]:
        if self._thread is None:
            # A daemon thread does not keep a program from ending that forgot to close the solver.
            self._thread = threading.Thread(target=self._run, name=f"solver {self.name}", daemon=True)
            self._thread.start()
        self._asking = True
        request = self._requests.get()
        self._asking = False
        if isinstance(request, list):
            return request
        if isinstance(request, BaseException):
            self._end(False, error_text(request))
            raise request
        self._end(*request)
        return []

    def _learn(self, evaluations: Sequence[Evaluation], by_hand: Sequence[Evaluation]) -> None:
        if evaluations:
            self._answers.put(evaluations)

    def close(self) -> None:
        """End the method and its thread, and an `ask` that waits in another thread."""
        self._stopping = True
        if self._thread is None:
            return
        self._answers.put(None)
        self._thread.join(self.late_grace if self._asking else self.grace)
        if self._thread.is_alive():
            _log.warning("%s does not return: its thread is left behind", self.name)
        self._requests.put((False, "it was closed"))
