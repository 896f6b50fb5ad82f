"""The slow parts of a DPS: computations that take longer than a cycle of the fast loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import ceil, inf
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, Diagram, DiscreteStateIndex, EventStatus, InputPort, State

from vtbdrake.common.argument_checks import as_number
from vtbdrake.drake_workarounds.event_times import SAMPLED_EARLY, SHOWN_EARLY
from vtbdrake.state import AddressedSystem, Codec, Quantity
from vtbdrake.state.codecs import array_codec, codec_of
from vtbdrake.state.declarations import weakly
from vtbdrake.state.systems import leaves
from vtbdrake.testbed.dps_state import DPS_STATE_CODEC, DpsReader, RootReference
from vtbdrake.testbed.slow_function import (
    MEMORY,
    Arrays,
    SlowFunction,
    SlowPartError,
    decode,
    encode,
    read_only,
    split_memory,
)
from vtbdrake.testbed.slow_progress import PROGRESS_CODEC, Progress, Work, WorkStatus

MOST_UNDER_WAY = 16
_SHORTEST = 1e-6  # s
_SAMPLED_AT = "sampled_at"
_VALID = "valid"
_MISSED = "missed"
_REQUEST = "request"
_TAKEN = "taken"
_DPS = "dps"
_RESERVED = ("tick", MEMORY, _SAMPLED_AT, _VALID, _MISSED, _REQUEST, _TAKEN, _DPS)


@dataclass(frozen=True)
class _Signature:
    """What the function of a slow part takes and returns: sizes or model values, by name, and their codecs.

    Attributes:
        inputs: What arrives by input ports; the request is one of them.
        outputs: What is returned.
        memory: The initial memory under its name; empty if there is none.
        codecs: The codec of each of these.
        samples_dps: Whether the function also gets the state of the whole DPS.
    """

    inputs: Mapping[str, Any]
    outputs: Mapping[str, Any]
    memory: Mapping[str, Any]
    codecs: Mapping[str, Codec]
    samples_dps: bool

    def slow_function(self, function: Callable[..., Any], *, makes: frozenset[str]) -> SlowFunction:
        inputs, outputs, memory = (
            {name: self.codecs[name] for name in names} for names in (self.inputs, self.outputs, self.memory)
        )
        if self.samples_dps:
            inputs[_DPS] = DPS_STATE_CODEC
        return SlowFunction(function, inputs, outputs, memory, makes)

    def first_outputs(self, initial: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Return the arrays of the outputs until the first result."""
        first = {name: np.zeros(model) if _is_size(model) else model for name, model in self.outputs.items()}
        return encode({**first, **initial}, {name: self.codecs[name] for name in self.outputs})

    def first_memory(self) -> dict[str, np.ndarray]:
        """Return the arrays of the memory that the first call begins with."""
        return encode(self.memory, {name: self.codecs[name] for name in self.memory})


def _signature(
    inputs: Mapping[str, Any],
    outputs: Mapping[str, Any],
    memory: Any,
    initial: Mapping[str, Any],
    codecs: Mapping[str, Codec],
    *,
    on_request: bool,
    samples_dps: bool,
) -> _Signature:
    """Return the signature by the arguments of `SlowPart`, checked."""
    memories = {} if memory is None else {MEMORY: memory}
    models = {**inputs, **outputs, **memories}
    coded = {name: models.get(name) for name in codecs}
    _check_names(inputs, outputs, initial, coded, on_request or samples_dps)
    codecs_by_name = {name: codecs.get(name) or _codec(name, model) for name, model in models.items()}
    if on_request:
        inputs = {**inputs, _REQUEST: 1}
        codecs_by_name[_REQUEST] = array_codec((1,))
    return _Signature(inputs, outputs, memories, codecs_by_name, samples_dps)


class SlowPart(AddressedSystem):
    """A part of a DPS that takes longer than a cycle of the loop: perception, a planner, a localization.

    .. pydrake_system::

        name: SlowPart
        input_ports:
        - <input>
        - request (only with ``on_request``)
        - dps (only with ``samples_dps``; filled by `AddressedDiagram.attach`)
        output_ports:
        - <output>
        - sampled_at (s; when the inputs of the present outputs were sampled, at first -inf)
        - valid (1 if the result that was due last arrived in time, else 0)
        - missed (the number of results that did not)
        - taken (only with ``on_request``: the request that was taken last, at first 0)

    At t_k = offset + k period the part samples its inputs. From t_k + latency on, its outputs show ``function`` of
    these inputs, also to systems that are updated at that very instant. Until the first result they show ``initial``.

    In a simulation, the function is computed when its result is due. A runtime computes it in another process, and
    delivers the result with `deliver` at any time before. If a result is declared missing, the outputs stay unchanged.
    A result that has neither arrived nor been declared missing is computed here, so that a copy of a running context
    can continue without a runtime. If the function returns None, the result is missing.

    On request, the part samples its inputs at the first t_k at which the request is neither 0 nor the one that was
    taken last, and no other request is being worked on. A request that comes meanwhile, and stays, is taken afterwards.

    All memory of the part lies in its context, as arrays: up to latency / period samples and results under way, and the
    memory of the function.

    Args:
        function: ``function(**inputs)`` returns the outputs by name, or the value of a single output. It depends on
            nothing else and has no side effects. It is sent to the other process by cloudpickle. If it has a method
            ``prepare``, the process beside a loop calls that once, before the first sample; a simulation does not.
        inputs: Name -> the size of a vector port, or a model value of an abstract one.
        outputs: Name -> size or model value, as for the inputs.
        period, latency, offset: Times in seconds. The latency may be longer than the period.
        initial: Outputs until the first result; by default zeros, and the model values in ``outputs``.
        memory: Initial memory of the function: it gets the argument ``memory``, and returns ``(outputs, memory)``. A
            call begins with the memory of the last call whose result has arrived, even if too late to be shown.
        on_request: Whether the part works on request only. The function gets the ``request``, shape (1,).
        samples_dps: Whether the function also gets ``dps``, the state of the whole DPS as a `DpsState`. A DPS has at
            most one such part, which works on one sample at a time.
        codecs: Port name or ``memory`` -> the codec of its values, if `codec_of` has none.
        patience: The number of latencies without an answer after which a runtime replaces the other process.

    Attributes:
        function: The function from arrays to arrays, see `SlowFunction`.
        samples_dps: Whether the function gets the state of the whole DPS.

    Raises:
        ValueError: A name or a time is impossible, more than 16 samples would be under way (or, of the state of the
            DPS, more than one), or a value has no codec.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        *,
        inputs: Mapping[str, Any],
        outputs: Mapping[str, Any],
        period: float,
        latency: float,
        offset: float = 0.0,
        initial: Mapping[str, Any] | None = None,
        memory: Any = None,
        on_request: bool = False,
        samples_dps: bool = False,
        codecs: Mapping[str, Codec] | None = None,
        patience: float = 20.0,
    ) -> None:
        super().__init__()
        _check_times(period, latency, offset, patience)
        if not on_request:
            _check_under_way(period, latency, offset, 1 if samples_dps else MOST_UNDER_WAY)
        signature = _signature(
            inputs, outputs, memory, initial or {}, codecs or {}, on_request=on_request, samples_dps=samples_dps
        )
        shown, remembered = signature.first_outputs(initial or {}), signature.first_memory()
        self.period, self.latency, self.offset, self.patience = period, latency, offset, patience
        self.samples_dps = samples_dps
        self.function = signature.slow_function(function, makes=frozenset({*shown, *remembered}))
        self._inputs = {name: self._declare_input(name, model) for name, model in signature.inputs.items()}
        self._request = self._inputs.get(_REQUEST)
        self._root = self._declare_input(_DPS, RootReference()) if samples_dps else None
        self._read_dps: DpsReader | None = None
        self._vectors = tuple(name for name, model in outputs.items() if _is_size(model))
        first_vectors = {name: shown.pop(name) for name in self._vectors}
        self._indices = self._declare_numbers(first_vectors, on_request=on_request)
        self._progress = self.DeclareAbstractState(Value(Progress(shown, remembered)))
        for name, model in outputs.items():
            if name not in self._vectors:
                self._declare_abstract_output(name, model)
        for name, index in self._indices.items():
            self.DeclareStateOutputPort(name, DiscreteStateIndex(index))
        self.codecs = {int(self._progress): PROGRESS_CODEC}
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, self.sampled(0), self._sample)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, self.due(0), self._show)
        # These events come before the instants of others, to which the samples of a rollout belong.
        self.timings = ()

    @property
    def groups(self) -> Mapping[str, int]:
        """Return the number of the discrete state group that each vector output port shows, by name."""
        return self._indices

    def _declare_input(self, name: str, model: Any) -> InputPort:
        if _is_size(model):
            return self.DeclareVectorInputPort(name, model)
        return self.DeclareAbstractInputPort(name, Value(model))

    def _declare_numbers(self, vectors: Arrays, *, on_request: bool) -> dict[str, int]:
        """Declare a group of discrete state for each vector output and each number about the results; return them."""
        quantities = {name: Quantity(first if len(first) > 1 else first.item()) for name, first in vectors.items()}
        quantities |= {
            _SAMPLED_AT: Quantity(-inf, "s"),
            _VALID: Quantity(0.0, bounds=(0.0, 1.0)),
            _MISSED: Quantity(0.0, bounds=(0.0, inf)),
        }
        if on_request:
            quantities[_TAKEN] = Quantity(0.0)
        return {
            name: int(self.declare_discrete_state(**{name: quantity}).index) for name, quantity in quantities.items()
        }

    def _declare_abstract_output(self, name: str, model: Any) -> None:
        codec = self.function.outputs[name]
        read = weakly(self, SlowPart._read)

        def calc(context: Context, output: AbstractValue) -> None:
            output.set_value(decode(read(context).shown, name, codec))

        ticket = self.abstract_state_ticket(self._progress)
        self.DeclareAbstractOutputPort(name, lambda: Value(model), calc, prerequisites_of_calc={ticket})

    def _read(self, context: Context) -> Progress:
        progress: Progress = context.get_abstract_state(self._progress).get_value()
        return progress

    # -- while time runs

    def _sample(self, context: Context, state: State) -> EventStatus:
        value = state.get_mutable_abstract_state().get_mutable_value(int(self._progress))
        progress: Progress = value.get_value()
        tick = self._tick(context, 0.0)
        # After an exception in one of them, the events of an instant are repeated.
        if progress.find(tick) is not None or not self._is_wanted(context, progress):
            return EventStatus.DidNothing()
        sample = {name: port.Eval(context) for name, port in self._inputs.items()}
        if self._read_dps is not None:
            sample[_DPS] = self._read_dps(self._root_of(context))
        if self._request is not None:
            self._take_request(context, state)
        work = Work(tick, WorkStatus.WAITING, encode(sample, self.function.inputs))
        value.set_value(replace(progress, under_way=(*progress.under_way, work)))
        return EventStatus.Succeeded()

    def _is_wanted(self, context: Context, progress: Progress) -> bool:
        if self._request is None:
            return True
        request, taken = self._request.Eval(context)[0], self._number(context, _TAKEN)
        return abs(request) > 0.0 and request != taken and not progress.under_way  # NaN is no request.

    def _take_request(self, context: Context, state: State) -> None:
        assert self._request is not None
        self._set_numbers(state, {_TAKEN: self._request.Eval(context)})

    def _root_of(self, context: Context) -> Context:
        assert self._root is not None
        reference: RootReference = self._root.Eval(context) if self._root.HasValue(context) else RootReference()
        return reference.find(self, context)

    def _show(self, context: Context, state: State) -> EventStatus:
        value = state.get_mutable_abstract_state().get_mutable_value(int(self._progress))
        progress: Progress = value.get_value()
        tick = self._tick(context, self.latency)
        work = progress.find(tick)
        if work is None:
            return EventStatus.DidNothing()
        if work.status == WorkStatus.WAITING:
            progress = progress.having(tick, self.function({**work.arrays, **progress.memory}))
            work = progress.find(tick)
            assert work is not None
        if work.status == WorkStatus.DONE:
            outputs = dict(work.arrays)
            self._show_vectors(state, tick, {name: outputs.pop(name) for name in self._vectors})
            progress = progress.after(work, shown=outputs)
        else:
            self._set_numbers(state, {_MISSED: [self._number(context, _MISSED) + 1.0], _VALID: [0.0]})
            progress = progress.after(work, shown=progress.shown)
        value.set_value(progress)
        return EventStatus.Succeeded()

    def _tick(self, context: Context, delay: float) -> int:
        """Return the number of the sample that was taken ``delay`` seconds ago."""
        return round((context.get_time() - self.offset - delay) / self.period)

    def _show_vectors(self, state: State, tick: int, vectors: Arrays) -> None:
        """Show vector outputs of the result of sample number ``tick``."""
        self._set_numbers(state, {**vectors, _SAMPLED_AT: [self.offset + tick * self.period], _VALID: [1.0]})

    def _number(self, context: Context, name: str) -> float:
        return float(context.get_discrete_state(self._indices[name]).value()[0])

    def _set_numbers(self, state: State, numbers: Mapping[str, ArrayLike]) -> None:
        for name, number in numbers.items():
            state.get_mutable_discrete_state().set_value(self._indices[name], number)

    # -- the state of the whole DPS, for a part that samples it

    def sample_dps_by(self, read: DpsReader) -> None:
        """Set the reader of the state of the DPS; called once, by the finished Diagram."""
        self._read_dps = read

    def attach(self, context: Context) -> None:
        """Make the state of the DPS in ``context`` known to this part; see `AddressedDiagram.attach`.

        Args:
            context: A root context of the whole Diagram.
        """
        assert self._root is not None
        self._root.FixValue(self.GetMyMutableContextFromRoot(context), Value(RootReference(context)))

    # -- results from outside

    def sampled(self, tick: int) -> float:
        """Return the time at which sample ``tick`` is taken, in seconds: just before its instant, not before 0."""
        return max(0.0, self.offset - SAMPLED_EARLY) + tick * self.period

    def due(self, tick: int) -> float:
        """Return the time at which the result of sample ``tick`` is shown, in s: just before a latency has passed."""
        return self.offset + self.latency - SHOWN_EARLY + tick * self.period

    def waiting(self, context: Context) -> dict[int, Arrays]:
        """Return the samples whose results have neither arrived nor been declared missing, by tick, in order.

        Args:
            context: A root context of the whole Diagram.
        """
        progress = self._read(self.GetMyContextFromRoot(context))
        return {work.tick: work.arrays for work in progress.under_way if work.status == WorkStatus.WAITING}

    def memory(self, context: Context) -> Arrays:
        """Return the memory that the next call begins with; empty for a part without."""
        return self._read(self.GetMyContextFromRoot(context)).memory

    def function_beside(self, period: float) -> SlowFunction:
        """Return the function for a process beside a loop with this period in seconds.

        The time for an answer is the latency less a period: a sample is sent after a step, and the answer is needed
        before another step.
        """
        return self.function

    def deliver(self, context: Context, tick: int, arrays: Arrays) -> None:
        """Deliver the result of sample number ``tick``: it is shown when it is due; its memory is used at once.

        If the result is not awaited, only its memory is used.

        Args:
            context: A root context of the whole Diagram.
            tick: The number of the sample.
            arrays: The arrays that `function` returned, or its memory alone; an empty mapping declares the result
                missing.

        Raises:
            SlowPartError: The arrays have other names or shapes.
        """
        self._check_result(arrays)
        part_context = self.GetMyMutableContextFromRoot(context)
        part_context.SetAbstractState(self._progress, self._read(part_context).having(tick, read_only(arrays)))

    def _check_result(self, arrays: Arrays) -> None:
        memory, outputs = split_memory(arrays)
        whole_memory, whole_outputs = (part.keys() for part in split_memory(dict.fromkeys(self.function.makes)))
        if memory.keys() not in (set(), whole_memory) or outputs.keys() not in (set(), whole_outputs):
            expected = ", ".join(sorted(self.function.makes))
            raise SlowPartError(f"the result of a slow part has the arrays {expected}, not {', '.join(arrays)}")
        for name in outputs.keys() & self._vectors:
            size = self.GetOutputPort(name).size()
            if arrays[name].shape != (size,):
                raise SlowPartError(f"the result {name} has {size} entries, not the shape {arrays[name].shape}")


def slow_parts(diagram: Diagram) -> dict[str, SlowPart]:
    """Return the slow parts in the DPS of a testbed's diagram, by path."""
    dps_systems = {path: system for path, system in leaves(diagram) if path == "dps" or path.startswith("dps.")}
    return {path: system for path, system in dps_systems.items() if isinstance(system, SlowPart)}


def _is_size(model: Any) -> bool:
    return isinstance(model, int | np.integer) and not isinstance(model, bool)


def _codec(name: str, model: Any) -> Codec:
    try:
        return array_codec((model,)) if _is_size(model) else codec_of(model)
    except ValueError as error:
        raise ValueError(f"{name} of a slow part: {error}") from error


def _check_times(period: float, latency: float, offset: float, patience: float) -> None:
    for name, value in {"period": period, "latency": latency, "patience": patience}.items():
        if not _SHORTEST <= as_number(f"the {name} of a slow part", value) < inf:
            raise ValueError(f"the {name} of a slow part is finite, and at least {_SHORTEST:g}, not {value}")
    if not 0.0 <= as_number("the offset of a slow part", offset) < inf:
        raise ValueError(f"a slow part begins at a finite time that is not negative, not at {offset} s")


def _check_under_way(period: float, latency: float, offset: float, most: int) -> None:
    if ceil(latency / period) > most:
        owner = "a slow part" if most > 1 else "a slow part that samples the state of the DPS"
        raise ValueError(
            f"with a period of {period:g} s and a latency of {latency:g} s, {ceil(latency / period)} samples of "
            f"{owner} would be under way; choose a period of at least {latency / most:g} s"
        )
    if most == 1 and offset > 0.0 and latency >= period:
        raise ValueError(
            f"a slow part that samples the state of the DPS at an offset of {offset:g} s needs a period longer than "
            f"its latency of {latency:g} s, so that a result is shown before the next sample"
        )


def _check_names(
    inputs: Mapping[str, Any],
    outputs: Mapping[str, Any],
    initial: Mapping[str, Any],
    coded: Mapping[str, Any],
    special: bool,
) -> None:
    if not (inputs or special) or not outputs:
        raise ValueError("a slow part has at least one input and one output")
    for name, model in [*inputs.items(), *outputs.items()]:
        if not name.isidentifier() or name in _RESERVED:
            raise ValueError(
                f"a port of a slow part has a name like a variable's, and none of {', '.join(_RESERVED)}; not {name!r}"
            )
        if _is_size(model) and model < 1:
            raise ValueError(f"{name} of a slow part has at least one entry, not {model}")
    if both := inputs.keys() & outputs.keys():
        raise ValueError(f"inputs and outputs of a slow part have different names, but both have {', '.join(both)}")
    if unknown := initial.keys() - outputs.keys():
        raise ValueError(f"initial names no output of the slow part: {', '.join(sorted(unknown))}")
    for name, model in coded.items():
        if model is None or _is_size(model):
            raise ValueError(f"a codec is for an abstract port or the memory of a slow part, not for {name}")
