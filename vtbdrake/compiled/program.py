"""The program of a rollout: the updates and records of all its instants as one function, and its machine code."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

import casadi
import numpy as np

from vtbdrake.common.arrays import Array
from vtbdrake.common.lru import LruDict
from vtbdrake.compiled.schedule import Instant
from vtbdrake.compiled.state_vector import ENDING, ENDING_TIME
from vtbdrake.components.casadi_system.kernel import Buffers

# Steps that are called one after the other before they become a function of their own.
_UNROLLED = 16
# Largest number of rollouts in one call of a function.
_MOST_ROLLOUTS = 128
# Largest size of the arguments and results of one call, in bytes.
MOST_BYTES = 8_000_000
# Number of batch sizes for which a function is kept, with its memory.
_MAX_SIZES = 16


class Program:
    """The rollout over a number of instants as machine code.

    Args:
        function: The function of one rollout; see `rollout_function`.
        count: The number of instants.
        translate: Makes machine code of a function, or returns it as it is.

    Attributes:
        count: The number of instants.
        function: The function of one rollout; see `rollout_function`.
        most: The largest number of rollouts in one call of `run`.
    """

    def __init__(
        self, function: casadi.Function, count: int, translate: Callable[[casadi.Function], casadi.Function]
    ) -> None:
        self.count = count
        self.function = function
        arguments = self.function.mx_in()
        results: Any = self.function(*arguments)
        packed = casadi.Function("rollout", arguments, [casadi.vertcat(*map(casadi.vec, results))])
        self._packed = translate(packed)
        self.is_machine_code = self._packed is not packed
        bytes_each = 8 * (packed.nnz_in() + packed.nnz_out())
        self.most = min(max(MOST_BYTES // bytes_each, 1), _MOST_ROLLOUTS)
        self._buffers: LruDict[int, Buffers] = LruDict(_MAX_SIZES)
        self._lock = threading.Lock()

    def plan(self, instants: Sequence[Instant]) -> Array:
        """Return [time, whether to record, whether each timing is due] of each instant, shape (count, 2 + timings)."""
        plan = np.zeros((self.count, self.function.size1_in(1)))
        for row, instant in zip(plan, instants, strict=False):
            row[:2] = instant.time, instant.is_sample
            row[[2 + k for k in instant.updates]] = 1.0
        return plan

    def run(self, z: Array, noise: Array | None, plan: Array) -> tuple[Array, Array]:
        """Return z at the end, shape (n, nz), and the records of all instants, shape (n, count, ny).

        The thread's next call overwrites the records.

        Args:
            z: State and parameters at the start, shape (n, nz).
            noise: The random numbers, shape (n, count, noise), or (1, ...) if all rollouts have the same; None: none.
            plan: What happens at the instants, see `plan`: one for all rollouts, or one for each in front.
        """
        n, nz = z.shape
        with self._lock:
            buffers = self._buffers.use(n)
            if buffers is None:
                buffers = Buffers(self._packed.map(n) if n > 1 else self._packed, may_fail=False)
                self._buffers.add(n, buffers)
        arguments, evaluate, result = buffers.parts
        size = self.count * plan.shape[-1]
        arguments[: n * nz] = z.ravel()
        arguments[n * nz : n * (nz + size)].reshape(n, -1)[:] = plan.reshape(-1, size)
        if noise is not None:
            arguments[n * (nz + size) :].reshape(n, -1)[:] = noise.reshape(len(noise), -1)
        evaluate()
        rows = result.reshape(n, -1)
        return rows[:, :nz].copy(), rows[:, nz:].reshape(n, self.count, -1)


def rollout_function(
    updates: Sequence[casadi.Function],
    unrestricted: Sequence[bool],
    record: casadi.Function,
    count: int,
    *,
    may_end: bool,
) -> casadi.Function:
    """Return the function (z, instants, w) -> (z, recorded) of ``count`` instants.

    A column of ``instants`` is [time, whether to record, whether each of the updates is due]. Unrestricted updates come
    first; all of one kind begin with the same z.

    Args:
        updates: The functions (before, z, time, w) -> z of the updates.
        unrestricted: Whether each of them is an unrestricted update.
        record: The function (z, time, w) of what is recorded.
        count: The number of instants.
        may_end: Whether a system may end the simulation: nothing is updated after that, and samples are of its end.
    """
    z, time, w = record.sx_in()
    nothing = casadi.Function("nothing", [z, time, w], [casadi.SX.zeros(record.numel_out(0), 1)])
    sample = casadi.Function.if_else("sample", record, nothing)
    begin, instant, random = (
        casadi.MX.sym(name, size) for name, size in (("z", z.numel()), ("instant", 2 + len(updates)), ("w", w.numel()))
    )
    state, has_ended = begin, begin[ENDING] > 0.0
    for kind in (True, False):
        before = state
        for k, update in enumerate(updates):
            if unrestricted[k] == kind:
                other = casadi.SX.sym("before", z.numel())
                keep = casadi.Function(f"keep_{k}", [other, z, time, w], [z])
                if_due = casadi.Function.if_else(f"due_{k}", update, keep)
                is_due = casadi.if_else(has_ended, 0.0, instant[2 + k]) if may_end else instant[2 + k]
                state = if_due(is_due, before, state, instant[0], random)
    when = casadi.if_else(has_ended, begin[ENDING_TIME], instant[0]) if may_end else instant[0]
    recorded = sample(instant[1], begin, when, random)
    return _repeated(casadi.Function("step", [begin, instant, random], [state, recorded]), count)


def _repeated(step: casadi.Function, count: int) -> casadi.Function:
    """Return the function of ``count`` instants: blocks of blocks of steps, so that its code stays short."""
    blocks = {1: step}
    while max(blocks) * _UNROLLED < count:
        size = max(blocks)
        blocks[size * _UNROLLED] = _chained([blocks[size]] * _UNROLLED, [size] * _UNROLLED)
    sizes: list[int] = []
    for size in sorted(blocks, reverse=True):
        sizes += [size] * ((count - sum(sizes)) // size)
    return _chained([blocks[size] for size in sizes], sizes)


def _chained(functions: Sequence[casadi.Function], sizes: Sequence[int]) -> casadi.Function:
    """Return the function of the instants of several functions, one after the other."""
    total = sum(sizes)
    begin, instants, w = (
        casadi.MX.sym(name, rows, columns)
        for name, rows, columns in (
            ("z", functions[0].size1_in(0), 1),
            ("instants", functions[0].size1_in(1), total),
            ("w", functions[0].size1_in(2), total),
        )
    )
    ends = np.cumsum([0, *sizes]).tolist()
    z, recorded = begin, []
    parts = zip(functions, casadi.horzsplit(instants, ends), casadi.horzsplit(w, ends), strict=True)
    for function, when, random in parts:
        z, y = function(z, when, random)
        recorded.append(y)
    return casadi.Function(f"rollout_{total}", [begin, instants, w], [z, casadi.horzcat(*recorded)])
