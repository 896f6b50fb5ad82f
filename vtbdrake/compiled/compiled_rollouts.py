"""Many rollouts of a compiled Diagram in one call."""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import inf
from typing import Any, NoReturn

import casadi
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram

from vtbdrake.common.argument_checks import as_addresses, as_array, as_flag, as_number, as_whole
from vtbdrake.common.arrays import Array
from vtbdrake.common.lru import LruDict
from vtbdrake.compiled.equations import Timing, UnsupportedTestbedError
from vtbdrake.compiled.leaf_systems import LeafSystems
from vtbdrake.compiled.plant import TERRAIN
from vtbdrake.compiled.program import Program, rollout_function
from vtbdrake.compiled.schedule import Instant, schedule
from vtbdrake.compiled.state_vector import DOUBT, DOUBT_TIME, ENDING, ENDING_TIME
from vtbdrake.compiled.walker import InstantOutputs, Walker
from vtbdrake.components.casadi_system.kernel import TRANSLATIONS
from vtbdrake.components.compiled_plant.contact import FixedPiece
from vtbdrake.components.compiled_plant.ground import Terrain
from vtbdrake.components.compiled_plant.links import UnsupportedPlantError
from vtbdrake.drake_workarounds.making import making
from vtbdrake.state import Variables
from vtbdrake.testbed.addressed import check_root
from vtbdrake.testbed.instants import sample_instants, sample_times

_log = logging.getLogger(__name__)

# Number of lengths of rollouts, in instants, for which a program is kept.
_MAX_PROGRAMS = 8
# Samples and updates of a rollout; ten million take about 5 GB.
_MOST_INSTANTS = 1e7


@dataclass(frozen=True)
class CompiledBatch:
    """The results of n rollouts.

    Attributes:
        times: The sample times from the begin, shape (m,), in seconds.
        outputs: The recorded values by address, each of shape (n, m, ...).
        final: The vectors z of state and parameters at the end, shape (n, nz).
        valid: Mask of the rollouts that equal the Diagram's, shape (n,): all state is finite all the time, and each
            step of a plant has converged, also in what is recorded at the samples.
        reasons: Why and at which time a rollout ceased to equal the Diagram's; empty for those that are valid.
        ends: The times from the begin at which a system has ended the simulation, shape (n,), in seconds; else inf.
        counts: The number of samples of each rollout, shape (n,). Where a system has ended it, the last one is the
            state at that time, and later rows of the outputs repeat it.
        messages: What Drake's Simulator tells about the end; empty where no system has ended the simulation.
    """

    times: Array
    outputs: Mapping[str, Array]
    final: Array
    valid: NDArray[np.bool_]
    reasons: tuple[str, ...]
    ends: Array
    counts: NDArray[np.intp]
    messages: tuple[str, ...]


class CompiledRollouts:
    """A Diagram as one function for a whole rollout; see `VirtualTestbed.compiled`.

    A rollout is the one that Drake's Simulator makes: the same updates in the same order. Several threads may call it
    at once.

    Attributes:
        walker: The Diagram as expressions.
        parameters: The addresses that a call can vary; others that lie in the compiled state can be, too.
        outputs: The addresses that are recorded.
        times: The sample times from the begin (s), shape (m,).
        timings: (period, offset) of all periodic events, in seconds.
        columns: Where each output lies among the recorded values of an instant; the doubt is the last of these.
        shapes: The shape of each output.
        updates: The function (before, z, time, w) -> z of the updates of each timing of the walker, where ``before`` is
            z before all updates of its kind, which are unrestricted or not, and w holds the random numbers.
        record: The function (z, time, w) of what is recorded at an instant: the outputs by ``columns``, the
            time of the doubt and the doubt, see `Walker.reason`.
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
        """Compile a Diagram; raises the errors of `VirtualTestbed.compiled`.

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
            timings: (period, offset) of all periodic events; by default the events of the compiled systems.
        """
        _check_times(horizon, sample_period)
        _check_options(compile, check, workers)
        check_root(diagram, context)
        self.parameters = parameters = as_addresses("what varies", parameters)
        self.outputs = as_addresses("what to record", outputs)
        self._measures = dict(measures or {})
        self._translate = TRANSLATIONS[compile]
        self._workers = workers
        # One thread at a time: CasADi counts the references to its expressions without atomics.
        with making():
            self.walker = Walker(LeafSystems(diagram, context.Clone(), variables, parameters))
            self._z, self._time = casadi.SX.sym("z", self.walker.vector.size), casadi.SX.sym("time")
            self._w = casadi.SX.sym("w", max(1, self.walker.draws.size))
            recorded, doubt = self._recorded_values()
            self.shapes = {
                name: variables[name].shape if name in variables else (value.numel(),)
                for name, value in recorded.items()
            } | dict.fromkeys(self._measures, ())
            ends = np.cumsum([0, *(int(np.prod(shape, dtype=int)) for shape in self.shapes.values())]).tolist()
            self.columns = {name: slice(*ends[k : k + 2]) for k, name in enumerate(self.shapes)}
            result = casadi.densify(casadi.vertcat(*recorded.values(), doubt))
            self.record = casadi.Function("record", [self._z, self._time, self._w], [result], {"cse": True})
            self.updates = [self._update(k, timing) for k, timing in enumerate(self.walker.timings)]
        for address in parameters:
            self.walker.place(address)
        _refuse_many_instants(horizon, sample_period, [timing.period for timing in self.walker.timings])
        self.times = sample_times(horizon, sample_period)
        by_default = [(timing.period, timing.offset) for timing in self.walker.timings]
        self.timings = by_default if timings is None else list(timings)
        self._z0 = self.walker.read(self.walker.context)
        self._programs: LruDict[int, Program] = LruDict(_MAX_PROGRAMS)
        self._last_schedule: tuple[float, list[Instant]] = np.nan, []
        self._last_plan: tuple[list[Instant], Program, Array] | None = None
        self._last_noise: tuple[object, Array] = None, np.zeros(0)
        self._lock = threading.Lock()
        self._terrain: Terrain | None = None
        self._refuse_initialization()
        program = self.program(self.schedule_at(context.get_time()))
        if compile is None and not program.is_machine_code:
            _log.warning("the testbed is interpreted by CasADi, several times more slowly: see `vtbdrake doctor`")
        if check:
            from vtbdrake.compiled.agreement import check_rollouts

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

    def terrain(self, pieces: Sequence[FixedPiece]) -> Terrain:
        """Return another terrain than the one that is compiled in, for `stand_on`; nothing is compiled again.

        Args:
            pieces: The pieces of the terrain, in place of all fixed pieces that the plant's spheres may touch.

        Raises:
            ValueError: A piece is impossible.
            UnsupportedTestbedError: The Diagram has no plant with one ground, see `PointContact.terrain`.
        """
        try:
            terrain: Terrain = self._ground().terrain(pieces)
        except UnsupportedPlantError as error:
            raise UnsupportedTestbedError(str(error)) from None
        return terrain

    def stand_on(self, terrain: Terrain | None) -> None:
        """Let all rollouts from now on be on another terrain. No rollout may be under way.

        Args:
            terrain: The terrain; None: the one that is compiled in.
        """
        self._ground().constants[TERRAIN] = 0.0 if terrain is None else terrain.number
        self._terrain = terrain

    def _ground(self) -> Any:
        """Return the equations of the plant whose ground a terrain replaces."""
        grounds = [each for each in self.walker.equations.values() if TERRAIN in each.constants]
        if len(grounds) != 1:
            raise UnsupportedTestbedError(
                f"a terrain replaces the ground of one plant, but {len(grounds)} plants of the testbed have more than "
                "sixteen fixed pieces that each of their spheres may touch"
            )
        return grounds[0]

    def z_of(self, context: Context) -> Array:
        """Return the vector of state and parameters of a root context, shape (nz,)."""
        if context is self.walker.context:
            return self._z0.copy()
        check_root(self.walker.systems.diagram, context)
        self.walker.compiled_in.check_context(context)
        return self.walker.read(context)

    def filled(self, z: Array, values: Mapping[str, ArrayLike]) -> Array:
        """Return n copies of z with values by address, shape (n, nz); see `__call__`.

        Args:
            z: State and parameters, shape (nz,).
            values: Values by address; an array has n rows, one per copy.
        """
        arrays = {address: self._checked(address, value) for address, value in values.items()}
        counts = {len(array) for array in arrays.values()} - {1}
        if len(counts) > 1:
            numbers = ", ".join(f"{len(array)} of {address}" for address, array in arrays.items())
            raise ValueError(f"each rollout takes one value of each variable, but there are {numbers}")
        batch = np.repeat(z[np.newaxis], counts.pop() if counts else 1, axis=0)
        for address, array in arrays.items():
            batch[:, self.walker.place(address)] = array
        self.walker.vector.settle(z, batch, arrays)
        return batch

    def _checked(self, address: str, value: ArrayLike) -> Array:
        """Return the values of a variable, of one rollout or of n, as an array of shape (1 or n, size)."""
        variable = self.walker.systems.variables[address]
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
        """Make the rollouts that begin at the vectors z, shape (n, nz), and the time t0 (s).

        Args:
            z: State and parameters at the start, shape (n, nz).
            t0: The time at the start, in s.
        """
        self.walker.compiled_in.check_vectors(z, self._z0)
        z = self.walker.vector.with_constants(z)
        instants = self.schedule_at(t0)
        program, plan = self._planned(instants)
        chunks = [slice(k, k + program.most) for k in range(0, len(z), program.most)]
        # Every chunk writes into its rows: to put them together at the end would take the memory twice.
        final = np.empty_like(z)
        recorded = np.empty((len(z), len(self.times), self.record.numel_out(0)))

        def run(chunk: slice) -> None:
            noise = self._noise(z[chunk], instants, program.count)
            final[chunk], records = program.run(z[chunk], noise, plan)
            recorded[chunk] = records[:, plan[:, 1] != 0.0]

        if len(chunks) <= 1:
            run(slice(None))
        else:
            with ThreadPoolExecutor(self._workers) as pool:
                list(pool.map(run, chunks))
        # A doubt stays, and a sample sees more than the updates: the first one tells.
        doubted: NDArray[np.bool_] = ~(recorded[:, :, DOUBT] <= 0.0)
        first = recorded[np.arange(len(z)), doubted.argmax(axis=1)]
        reasons = tuple(self.walker.reason(doubt, time) for time, doubt in first[:, DOUBT_TIME:].tolist())
        outputs = {
            name: recorded[:, :, columns].reshape(*recorded.shape[:2], *self.shapes[name])
            for name, columns in self.columns.items()
        }
        valid: NDArray[np.bool_] = np.all(~doubted, axis=1)
        ends = final[:, ENDING_TIME]
        messages = tuple(self.walker.message(*row) for row in final[:, [ENDING, ENDING_TIME]].tolist())
        has_ended = final[:, ENDING] > 0.0
        instants_of_samples = [instant.time for instant in instants if instant.is_sample]
        before = np.searchsorted(instants_of_samples, ends, side="right")
        counts = np.where(has_ended, before + 1, len(self.times))
        ends = np.where(has_ended, ends - t0, inf)
        return CompiledBatch(self.times, outputs, final, valid, reasons, ends, counts, messages)

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
        return {name: recorded[columns, samples] for name, columns in self.columns.items()}

    def advanced(self, z: Array, instant: Instant) -> Array:
        """Return z, shape (nz,), after what happens at an instant; it is interpreted.

        Args:
            z: State and parameters, shape (nz,).
            instant: The instant, with its events.
        """
        w = self._noise_at(z, instant)
        for unrestricted in (True, False):
            before = z
            for k in instant.updates:
                if self.walker.timings[k].unrestricted == unrestricted:
                    z = self.updates[k](before, z, instant.time, w).full().ravel()
        return z

    def recorded(self, z: Array, instant: Instant) -> tuple[dict[str, Array], float]:
        """Return the recorded values of an instant by address, flat, and the doubt about them; it is interpreted.

        Args:
            z: State and parameters, shape (nz,).
            instant: The instant.
        """
        values = self.record(z, instant.time, self._noise_at(z, instant)).full().ravel()
        return {name: values[columns] for name, columns in self.columns.items()}, values[DOUBT]

    def read(self, address: str, context: Context) -> Any:
        """Return the value of an output in a root context.

        Args:
            address: Address of the output.
            context: A root context of the testbed.
        """
        return self.walker.systems.reader(address)(context)

    @property
    def function(self) -> casadi.Function:
        """Return the function of one rollout for CasADi's solvers: (z, instants, w) -> (z at the end, recorded).

        It is interpreted, and has derivatives. z is made by `filled`, its entries are told by ``walker.place``; the
        other arguments are returned by `arguments`. The recorded values have a column per instant; the last one is
        positive where z or they differ from the Diagram's, since the time in the last but one.
        """
        return self.program(self.schedule_at(self.walker.context.get_time())).function

    def arguments(self) -> tuple[Array, Array]:
        """Return the arguments of `function` beside z: the instants, shape (m, count), and the random numbers of s0."""
        instants = self.schedule_at(self.walker.context.get_time())
        program, plan = self._planned(instants)
        noise = self._noise(self._z0[np.newaxis], instants, program.count)
        return plan.T, np.zeros((self._w.numel(), program.count)) if noise is None else noise[0].T

    # -- how it is done

    def _refuse_initialization(self) -> None:
        probe = self.walker.context.Clone()
        simulator = Simulator(self.walker.systems.diagram, probe)
        simulator.Initialize()
        z = self.walker.read(probe)
        for block in self.walker.vector.blocks.values():
            if not np.array_equal(z[block.entries], self._z0[block.entries], equal_nan=True):
                raise UnsupportedTestbedError(
                    f"{block.path} is changed by an initialization event, which is not compiled: keep this testbed in "
                    "Drake, or compile it in a context that is initialized"
                )

    def _outputs_at_instant(self) -> InstantOutputs:
        return InstantOutputs(self.walker, self._z, self._time, self._w)

    def _recorded_values(self) -> tuple[dict[str, casadi.SX], casadi.SX]:
        """Return the recorded values by name, and the doubt."""
        measured = (address for _, of in self._measures.values() for address in of)
        addresses = list(dict.fromkeys([*self.outputs, *measured]))
        values, doubt = self.walker.record(addresses, self._outputs_at_instant())
        recorded = {address: values[address] for address in self.outputs}
        for name, (function, of) in self._measures.items():
            recorded[name] = casadi.densify(function(*(values[address] for address in of)))
        return recorded, doubt

    def _update(self, number: int, timing: Timing) -> casadi.Function:
        """Return the function (before, z, time, w) -> z of the updates of a timing.

        ``before`` is the z before all updates of its kind, which are unrestricted or not.
        """
        z = casadi.SX.sym("z", self.walker.vector.size)
        following = self.walker.update(timing, self._outputs_at_instant(), z)
        return casadi.Function(f"update_{number}", [self._z, z, self._time, self._w], [following], {"cse": True})

    def schedule_at(self, t0: float) -> list[Instant]:
        """Return the instants of a rollout that begins at t0 (s)."""
        t_last, instants = self._last_schedule
        if t_last != t0:
            instants = schedule(self.walker.timings, sample_instants(self.times, t0, self.timings))
            self._last_schedule = t0, instants
        return instants

    def program(self, instants: Sequence[Instant]) -> Program:
        """Return a program for as many instants; updates may coincide at any of them."""
        with self._lock, making():
            needed = len(instants)
            for count, program in self._programs.items():
                if needed <= count <= 1.25 * needed + 4:
                    self._programs.use(count)
                    return program
            # Rollouts of this length that begin at other times may have some more.
            count = needed + len(self.walker.timings)
            unrestricted = [timing.unrestricted for timing in self.walker.timings]
            may_end = bool(self.walker.endings)
            function = rollout_function(self.updates, unrestricted, self.record, count, may_end=may_end)
            program = Program(function, count, self._translate)
            self._programs.add(count, program)
            return program

    def _noise_at(self, z: Array, instant: Instant) -> Array:
        """Return the random numbers of one instant, shape (noise,)."""
        w: Array = self.walker.draws.numbers(self.walker.draws.seeds(z[np.newaxis]), [instant], 1)[0, 0]
        return w

    def _planned(self, instants: list[Instant]) -> tuple[Program, Array]:
        """Return the program for some instants, and its plan of them; both are kept for the last begin."""
        last = self._last_plan
        if last is None or last[0] is not instants:
            program = self.program(instants)
            last = self._last_plan = instants, program, program.plan(instants)
        return last[1:]

    def _noise(self, z: Array, instants: Sequence[Instant], count: int) -> Array | None:
        """Return the random numbers of all rollouts and instants, shape (n, count, noise), or (1, ...) if all agree."""
        if not self.walker.draws.size:
            return None
        seeds = self.walker.draws.seeds(z)
        if (seeds == seeds[0]).all():
            seeds = seeds[:1]
        key = seeds.tobytes(), instants[0].time, count
        last = self._last_noise
        if last[0] != key:
            last = self._last_noise = key, self.walker.draws.numbers(seeds, instants, count)
        return last[1]


def _check_options(compile: bool | None, check: bool, workers: int) -> None:
    if as_whole("the number of workers", workers) < 1:
        raise ValueError(f"compiled rollouts need at least one worker, not {workers}")
    if compile is not None:
        as_flag("compile", compile)
    as_flag("check", check)


def _check_times(horizon: float, sample_period: float) -> None:
    for name, time in {"horizon": horizon, "sample period": sample_period}.items():
        if not 0.0 < as_number(f"the {name}", time) < inf:
            raise ValueError(f"the {name} is a positive time in seconds, not {time}")


def _refuse_many_instants(horizon: float, sample_period: float, periods: Sequence[float]) -> None:
    """Refuse a rollout whose samples, and updates with these periods (s), do not fit into memory."""
    instants = horizon / sample_period + sum(horizon / period for period in periods)
    if instants > _MOST_INSTANTS:
        raise ValueError(
            f"a rollout of {horizon:g} s, with a sample each {sample_period:g} s, has {instants:.3g} samples and "
            f"updates, but at most {_MOST_INSTANTS:g} fit into memory when it is compiled: take a longer sample "
            "period, or a shorter horizon"
        )
