"""Many rollouts of a compiled Diagram in one call."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import inf
from typing import Any, NoReturn

import casadi
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram

from vtbdrake.argument_checks import as_addresses, as_array, as_flag, as_number, as_whole
from vtbdrake.arrays import Array
from vtbdrake.compiled.equations import UnsupportedTestbedError
from vtbdrake.compiled.plant import OVERRUN
from vtbdrake.compiled.schedule import Instant, schedule
from vtbdrake.compiled.walker import MEMORY, Walker
from vtbdrake.components.casadi_system.kernel import TRANSLATIONS, Buffers
from vtbdrake.lru import LruDict
from vtbdrake.state import Variables
from vtbdrake.testbed.addressed import check_root, making
from vtbdrake.testbed.instants import sample_instants, sample_times

_log = logging.getLogger(__name__)

# Steps that are called one after the other before they become a function of their own.
_UNROLLED = 16
# As many rollouts, with arguments and results of so many bytes, are made in one call of a function at most; functions
# are kept of so many sizes, with their memory.
_MOST_ROLLOUTS, _MOST_BYTES, _MAX_SIZES = 128, 8_000_000, 16

# Samples and updates of a rollout; ten million take about 5 GB.
_MOST_INSTANTS = 1e7

_NO_UPDATE = -1.0


@dataclass(frozen=True)
class CompiledBatch:
    """The results of n rollouts.

    Attributes:
        times: The sample times from the begin, shape (m,), in seconds.
        outputs: The recorded values by address, each of shape (n, m, ...).
        final: The vectors z of state and parameters at the end, shape (n, nz).
        valid: Which rollouts are those of the Diagram, shape (n,): all state is finite, and no joint has reached a
            stop, which the compiled plant does not have.
    """

    times: Array
    outputs: Mapping[str, Array]
    final: Array
    valid: NDArray[np.bool_]


class CompiledRollouts:
    """A Diagram as one function for a whole rollout; see `VirtualTestbed.compiled`.

    A rollout is the one that Drake's Simulator makes: the same updates in the same order. Several threads may call it
    at once.

    Attributes:
        walker: The Diagram as expressions.
        parameters: The addresses that a call can vary; others that lie in the compiled state can be, too.
        outputs: The addresses that are recorded.
        times: The sample times from the begin (s), shape (m,).
    """

    def __init__(
        self,
        diagram: Diagram,
        variables: Variables,
        context: Context,
        *,
        horizon: float,
        sample_period: float,
        parameters: Sequence[str] = (),
        outputs: Sequence[str] = (),
        measures: Mapping[str, tuple[casadi.Function, Sequence[str]]] | None = None,
        timings: Sequence[tuple[float, float]] | None = None,
        compile: bool | None = None,
        check: bool = True,
        workers: int = 1,
    ) -> None:
        """Compile a Diagram; the errors are those of `VirtualTestbed.compiled`.

        Args:
            diagram: The Diagram.
            variables: Its variables.
            context: A root context: the begin of a rollout, and what is compiled in.
            horizon: The length of a rollout (s).
            sample_period: The period of the samples (s).
            parameters: Addresses that will vary.
            outputs: Addresses to be recorded.
            compile: Whether to make machine code; None: if there is a C compiler.
            check: Whether to compare rollouts with Drake's.
            workers: The number of threads for large batches.
            measures: Functions of outputs that are recorded as well: name -> (function, addresses of its arguments).
            timings: (period, offset) of all periodic events; by default those of the compiled systems.
        """
        for name, time in {"horizon": horizon, "sample period": sample_period}.items():
            if not 0.0 < as_number(f"the {name}", time) < inf:
                raise ValueError(f"the {name} is a positive time in seconds, not {time}")
        if as_whole("the number of workers", workers) < 1:
            raise ValueError(f"compiled rollouts need at least one worker, not {workers}")
        if compile is not None:
            as_flag("compile", compile)
        as_flag("check", check)
        check_root(diagram, context)
        self.parameters = parameters = as_addresses("what varies", parameters)
        self.outputs = as_addresses("what to record", outputs)
        self._measures = dict(measures or {})
        self._translate = TRANSLATIONS[compile]
        self._workers = workers
        # One thread at a time: CasADi counts the references to its expressions without atomics.
        with making():
            self.walker = Walker(diagram, context.Clone(), variables, parameters)
            self._z, self._time = casadi.SX.sym("z", self.walker.size), casadi.SX.sym("time")
            self._w = casadi.SX.sym("w", max(1, self.walker.noise))
            self._recorded = self._recorded_values()
            self._shapes = self._output_shapes(variables)
            self._record = casadi.Function("record", [self._z, self._time, self._w], [self._recorded], {"cse": True})
        for address in parameters:
            self.walker.place(address)
        instants = horizon / sample_period + sum(horizon / timing.period for timing in self.walker.timings)
        if instants > _MOST_INSTANTS:
            raise ValueError(
                f"a rollout of {horizon:g} s, with a sample each {sample_period:g} s, has {instants:.3g} samples and "
                f"updates, but at most {_MOST_INSTANTS:g} fit into memory when it is compiled: take a longer sample "
                "period, or a shorter horizon"
            )
        self.times = sample_times(horizon, sample_period)
        by_default = [(timing.period, timing.offset) for timing in self.walker.timings]
        self._timings = by_default if timings is None else list(timings)
        self._z0 = self.walker.read(self.walker.context)
        self._overruns = [
            b.entries.start for b in self.walker.blocks.values() if b.kind == MEMORY and b.name == OVERRUN
        ]
        self._updates: dict[tuple[int, ...], casadi.Function] = {}
        self._programs: dict[tuple[int, tuple[tuple[int, ...], ...]], _Program] = {}
        self._last_schedule: tuple[float, list[Instant]] = np.nan, []
        self._last_plan: tuple[list[Instant], _Program, Array] | None = None
        self._last_noise: tuple[object, Array] = None, np.zeros(0)
        self._lock = threading.Lock()
        self._refuse_initialization()
        program = self._program(self.schedule_at(context.get_time()))
        if compile is None and not program.is_machine_code:
            _log.warning("the testbed is interpreted by CasADi, several times more slowly: see `vtbdrake doctor`")
        if check:
            from vtbdrake.compiled.check import check_rollouts

            check_rollouts(self, self.walker.context)

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "compiled rollouts cannot be pickled or copied: send the scenario, build it and compile it there; machine "
            "code that is there already is found"
        )

    def __call__(
        self, values: Mapping[str, ArrayLike] | None = None, *, context: Context | None = None
    ) -> CompiledBatch:
        """Make n rollouts.

        Args:
            values: Address -> values that are set at the begin: of all rollouts, in the variable's shape, or of each,
                with n in front.
            context: The root context from which the rollouts begin, by default the one that was compiled.

        Raises:
            ValueError: An address cannot be varied, or a value has another shape, is not finite, out of bounds, or
                impossible in another way; or the context is another Diagram's.
            UnsupportedTestbedError: The context differs from the compiled one in what is compiled in.
        """
        if values is not None and not isinstance(values, Mapping):
            raise ValueError(f"give what varies as {{address: values, ...}}, not as {values!r}")
        start = self.walker.context if context is None else context
        return self.from_z(self.filled(self.z_of(start), values or {}), start.get_time())

    def z_of(self, context: Context) -> Array:
        """Return the vector of state and parameters of a root context, shape (nz,)."""
        if context is self.walker.context:
            return self._z0.copy()
        check_root(self.walker.diagram, context)
        self.walker.check(context)
        return self.walker.read(context)

    def filled(self, z: Array, values: Mapping[str, ArrayLike]) -> Array:
        """Return n copies of z with values by address, shape (n, nz); see `__call__`."""
        arrays = {address: self._checked(address, value) for address, value in values.items()}
        counts = {len(array) for array in arrays.values()} - {1}
        if len(counts) > 1:
            numbers = ", ".join(f"{len(array)} of {address}" for address, array in arrays.items())
            raise ValueError(f"each rollout takes one value of each variable, but there are {numbers}")
        batch = np.repeat(z[np.newaxis], counts.pop() if counts else 1, axis=0)
        for address, array in arrays.items():
            batch[:, self.walker.place(address)] = array
        self.walker.settle(z, batch, arrays)
        return batch

    def _checked(self, address: str, value: ArrayLike) -> Array:
        """Return the values of a variable, of one rollout or of n, as an array of shape (1 or n, size)."""
        variable = self.walker.variables[address]
        array = as_array(address, value)
        many = array.ndim == len(variable.shape) + 1
        if array.shape[many:] != variable.shape:
            raise ValueError(f"{address} has the shape {variable.shape} or (n, ...) of it, not {array.shape}")
        lower, upper = variable.bounds
        allowed = np.isfinite(array) & (array >= lower) & (array <= upper)
        if not allowed.all():
            raise ValueError(
                f"{address} must be finite and lie in {variable.bounds_text()}, but one value is {array[~allowed][0]}"
            )
        if not array.size and many:
            raise ValueError(f"there are no values of {address}: give one, or one for each of the rollouts")
        return array.reshape(len(array) if many else 1, -1)

    def from_z(self, z: Array, t0: float) -> CompiledBatch:
        """Make the rollouts that begin at the vectors z, shape (n, nz), and the time t0 (s)."""
        self.walker.check_fixed(z, self._z0)
        instants = self.schedule_at(t0)
        program, plan = self._planned(instants)
        chunks = [z[k : k + program.most] for k in range(0, len(z), program.most)]

        def run(chunk: Array) -> tuple[Array, Array]:
            return program.run(chunk, self._noise(chunk, instants, program.count), plan)

        if len(chunks) <= 1:
            final, recorded = run(z)
        else:
            with ThreadPoolExecutor(self._workers) as pool:
                results = list(pool.map(run, chunks))
            final, recorded = (np.concatenate(parts) for parts in zip(*results, strict=True))
        valid = self.walker.is_finite(final)
        if self._overruns:
            valid &= (final[:, self._overruns] <= 0.0).all(axis=1)
        outputs = {}
        start = 0
        for name, shape in self._shapes.items():
            size = int(np.prod(shape, dtype=int))
            outputs[name] = recorded[:, :, start : start + size].reshape(*recorded.shape[:2], *shape)
            start += size
        return CompiledBatch(self.times, outputs, final, valid)

    def expressions(self, values: Mapping[str, Any]) -> dict[str, casadi.MX]:
        """Return the outputs of one rollout as expressions, for CasADi's solvers and its derivatives.

        They are interpreted, and so slower than a call. A mass does not scale an inertia that ``parameters`` names:
        give both.

        Args:
            values: Address -> an expression of its value, a column; the rest is as in the compiled context.

        Returns:
            Address -> the recorded values, shape (size, m): one column per sample.

        Raises:
            ValueError: An address cannot be varied, or a value is no expression of its shape.
        """
        z = casadi.MX(self._z0)
        for address, value in values.items():
            place = self.walker.place(address)
            size = place.stop - place.start
            try:
                expression = casadi.MX(value)
            except NotImplementedError:  # An SX, or no number.
                expression = casadi.MX(0, 0)
            if expression.shape not in ((1, 1), (size, 1)):
                raise ValueError(
                    f"{address} takes a casadi.MX of the shape ({size}, 1), or numbers, not {type(value).__name__} of "
                    f"{getattr(value, 'shape', None) or np.shape(value)}"
                )
            z[place] = expression
        _, recorded = self.function(z, *self.arguments())
        samples = [k for k, i in enumerate(self.schedule_at(self.walker.context.get_time())) if i.is_sample]
        sizes = [int(np.prod(shape, dtype=int)) for shape in self._shapes.values()]
        parts = casadi.vertsplit(recorded[:, samples], np.cumsum([0, *sizes]).tolist())
        return dict(zip(self._shapes, parts, strict=True))

    def advanced(self, z: Array, instant: Instant) -> Array:
        """Return z, shape (nz,), after what happens at an instant; it is interpreted."""
        w = np.zeros(self._w.numel())
        self.walker.draw_numbers(self.walker.seeds(z[np.newaxis])[0], instant.time, instant.updates, w)
        if not instant.updates:
            return z
        following: Array = self._update(instant.updates)(z, instant.time, w).full().ravel()
        return following

    def is_beyond(self, z: Array) -> bool:
        """Return whether a joint has reached a stop since the begin of the rollout that is at z."""
        return bool((z[self._overruns] > 0.0).any())

    def read(self, address: str, context: Context) -> Any:
        """Return the value of an output in a root context."""
        return self.walker.reader(address)(context)

    @property
    def function(self) -> casadi.Function:
        """Return the function of one rollout for CasADi's solvers: (z, instants, w) -> (z at the end, recorded).

        It is interpreted, and has derivatives. z is made by `filled`, its entries are told by ``walker.place``; the
        other arguments are returned by `arguments`. The recorded values have a column per instant.
        """
        return self._program(self.schedule_at(self.walker.context.get_time())).function

    def arguments(self) -> tuple[Array, Array]:
        """Return what `function` takes beside z: the instants, shape (3, count), and the random numbers of s0."""
        instants = self.schedule_at(self.walker.context.get_time())
        program, plan = self._planned(instants)
        noise = self._noise(self._z0[np.newaxis], instants, program.count)
        return plan.T, np.zeros((self._w.numel(), program.count)) if noise is None else noise[0].T

    # -- how it is done

    def _refuse_initialization(self) -> None:
        probe = self.walker.context.Clone()
        simulator = Simulator(self.walker.diagram, probe)
        simulator.Initialize()
        z = self.walker.read(probe)
        for block in self.walker.blocks.values():
            if not np.array_equal(z[block.entries], self._z0[block.entries], equal_nan=True):
                raise UnsupportedTestbedError(
                    f"{block.path} is changed by an initialization event, which is not compiled: keep this testbed in "
                    "Drake, or compile it in a context that is initialized"
                )

    def _recorded_values(self) -> casadi.SX:
        z, time, w = self._z, self._time, self._w
        values = {address: self.walker.output(address, z, time, w) for address in self._addresses()}
        recorded = [values[address] for address in self.outputs]
        for function, of in self._measures.values():
            recorded.append(casadi.densify(function(*(values[address] for address in of))))
        return casadi.vertcat(casadi.SX(0, 1), *recorded)

    def _addresses(self) -> list[str]:
        return list(dict.fromkeys([*self.outputs, *(a for _, of in self._measures.values() for a in of)]))

    def _output_shapes(self, variables: Variables) -> dict[str, tuple[int, ...]]:
        shapes: dict[str, tuple[int, ...]] = {}
        for address in self.outputs:
            if address in variables:
                shapes[address] = variables[address].shape
            else:
                shapes[address] = (self.walker.output(address, self._z, self._time, self._w).numel(),)
        return shapes | dict.fromkeys(self._measures, ())

    def schedule_at(self, t0: float) -> list[Instant]:
        """Return what happens in a rollout that begins at t0 (s)."""
        t_last, instants = self._last_schedule
        if t_last != t0:
            instants = schedule(self.walker.timings, sample_instants(self.times, t0, self._timings))
            self._last_schedule = t0, instants
        return instants

    def _update(self, due: tuple[int, ...]) -> casadi.Function:
        """Return the function (z, time, w) -> z of the updates of an instant."""
        if due not in self._updates:
            following = casadi.densify(self.walker.update(self._z, self._time, due, self._w))
            name = "_".join(["update", *map(str, due)])
            self._updates[due] = casadi.Function(name, [self._z, self._time, self._w], [following], {"cse": True})
        return self._updates[due]

    def _program(self, instants: Sequence[Instant]) -> _Program:
        with self._lock, making():
            dues = tuple(dict.fromkeys(instant.updates for instant in instants if instant.updates))
            needed = len(instants)
            for (count, covered), program in self._programs.items():
                if needed <= count <= 1.25 * needed + 4 and set(dues) <= set(covered):
                    return program
            count = needed + len(self.walker.timings)
            updates = {due: self._update(due) for due in dues}
            program = _Program(updates, self._record, count, self._translate)
            self._programs[count, dues] = program
            return program

    def _planned(self, instants: list[Instant]) -> tuple[_Program, Array]:
        """Return the program for some instants, and its plan of them; those of the last begin are kept."""
        last = self._last_plan
        if last is None or last[0] is not instants:
            program = self._program(instants)
            last = self._last_plan = instants, program, program.plan(instants)
        return last[1:]

    def _noise(self, z: Array, instants: Sequence[Instant], count: int) -> Array | None:
        """Return the random numbers of all rollouts and instants, shape (n, count, noise)."""
        if not self.walker.noise:
            return None
        seeds, inverse = np.unique(self.walker.seeds(z), axis=0, return_inverse=True)
        key = seeds.tobytes(), instants[0].time, count
        last = self._last_noise
        if last[0] != key:
            noise = np.zeros((len(seeds), count, self._w.numel()))
            for k, instant in enumerate(instants):
                for of_seeds, row in zip(seeds, noise[:, k], strict=True):
                    self.walker.draw_numbers(of_seeds, instant.time, instant.updates, row)
            last = self._last_noise = key, noise
        numbers: Array = last[1][inverse.ravel()]
        return numbers


class _Program:
    """The rollout over a number of instants as machine code.

    Attributes:
        count: The number of instants.
        function: The function of one rollout; see `_rollout`.
        most: The largest number of rollouts in one call of `run`.
    """

    def __init__(
        self,
        updates: Mapping[tuple[int, ...], casadi.Function],
        record: casadi.Function,
        count: int,
        translate: Callable[[casadi.Function], casadi.Function],
    ) -> None:
        self.count = count
        self._numbers = {due: float(k) for k, due in enumerate(updates)}
        self.function = _rollout(list(updates.values()), record, count)
        arguments = self.function.mx_in()
        results: Any = self.function(*arguments)
        packed = casadi.Function("rollout", arguments, [casadi.vertcat(*map(casadi.vec, results))])
        self._packed = translate(packed)
        self.is_machine_code = self._packed is not packed
        bytes_each = 8 * (packed.nnz_in() + packed.nnz_out())
        self.most = min(max(_MOST_BYTES // bytes_each, 1), _MOST_ROLLOUTS)
        self._buffers: LruDict[int, Buffers] = LruDict(_MAX_SIZES)
        self._lock = threading.Lock()

    def plan(self, instants: Sequence[Instant]) -> Array:
        """Return [time, number of the update, whether to record] of each instant, shape (count, 3)."""
        plan = np.tile([0.0, _NO_UPDATE, 0.0], (self.count, 1))
        numbers = self._numbers
        plan[: len(instants)] = [(i.time, numbers.get(i.updates, _NO_UPDATE), i.is_sample) for i in instants]
        return plan

    def run(self, z: Array, noise: Array | None, plan: Array) -> tuple[Array, Array]:
        """Return z at the end, shape (n, nz), and what was recorded, shape (n, m, ny); see `plan`."""
        n, nz = z.shape
        with self._lock:
            buffers = self._buffers.use(n)
            if buffers is None:
                buffers = Buffers(self._packed.map(n) if n > 1 else self._packed, may_fail=False)
                self._buffers.add(n, buffers)
        arguments, evaluate, result = buffers.parts
        arguments[: n * nz] = z.ravel()
        arguments[n * nz : n * (nz + plan.size)].reshape(n, -1)[:] = plan.ravel()
        if noise is not None:
            arguments[n * (nz + plan.size) :] = noise.ravel()
        evaluate()
        # The thread's next call overwrites the result.
        rows = result.reshape(n, -1)
        recorded = rows[:, nz:].reshape(n, self.count, -1)
        return rows[:, :nz].copy(), recorded[:, plan[:, 2] != 0.0]


def _rollout(updates: Sequence[casadi.Function], record: casadi.Function, count: int) -> casadi.Function:
    """Return the function (z, instants, w) -> (z, recorded) of ``count`` instants.

    A column of ``instants`` is [time, number of the update, whether to record]; there is no update of number -1.
    """
    z, time, w = record.sx_in()
    keep = casadi.Function("keep", [z, time, w], [z])
    nothing = casadi.Function("nothing", [z, time, w], [casadi.SX.zeros(record.numel_out(0), 1)])
    update = casadi.Function.conditional("update", list(updates) or [keep], keep)
    sample = casadi.Function.if_else("sample", record, nothing)
    state, instant, random = (
        casadi.MX.sym(name, size) for name, size in (("z", z.numel()), ("instant", 3), ("w", w.numel()))
    )
    results: Any = [update(instant[1], state, instant[0], random), sample(instant[2], state, instant[0], random)]
    return _repeated(casadi.Function("step", [state, instant, random], results), count)


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
            ("instants", 3, total),
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
