"""A functional mock-up unit (FMU) as a Drake system."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from math import inf
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common.value import Value
from pydrake.systems.framework import AbstractStateIndex, Context, DiscreteValues, EventStatus, State

from vtbdrake.common.argument_checks import as_array, as_flag, as_number
from vtbdrake.fmi.imported import FmuVariable, ImportedFmu, Ports
from vtbdrake.fmi.instances import FmuState, Instances
from vtbdrake.state import AddressedSystem, Codec, Quantity
from vtbdrake.state.codecs import codec_of
from vtbdrake.state.declarations import ParameterGroup

_NOT_BEGUN = FmuState(False, np.zeros(0, np.uint8), np.zeros(0), np.zeros(0))


class FmuSystem(AddressedSystem):
    """An FMU for co-simulation, of FMI 3 or FMI 2, which takes a step in each period.

    .. pydrake_system::

        name: FmuSystem
        input_ports:
        - <every port in inputs>
        output_ports:
        - <every port in outputs>

    At t = 0, T, 2 T, ... the inputs are read, and the FMU does a step of length T with them. As with a discrete plant,
    what is updated at t still sees the FMU's outputs at t, and from then on the ports show its outputs at t + T. So
    there is no direct feedthrough. An input port that nothing is connected to leaves the start value that the FMU's
    file tells.

    The whole state of the FMU is in the Context, serialized by the FMU itself: contexts can be cloned, saved and
    simulated side by side, as exactly as the FMU restores its state. It is initialized when it is first needed, at the
    time of its Context and with the parameters there.

    Arrays are vectors on ports, row after row. Integers, enumerations and booleans (0 and 1) are numbers on ports;
    another number is an error.

    Args:
        path: The FMU.
        period: The communication step T in s; by default the one that the file proposes.
        inputs: Names of inputs, which become ports of the same names; or port -> its inputs, one after the other:
            ``{"joint_position": ["q1", "q2"]}``. By default all inputs that hold numbers.
        outputs: Names of outputs, or port -> its outputs, likewise.
        parameters: Start values by name: of parameters, and of outputs and local variables that have one. Numbers are
            parameters of this system, and variables by address, where characters other than letters and digits are
            "_": the FMU takes what is in the Context when it begins, and later what is tunable.
        fork: False takes an FMU that cannot save its state. It then simulates from the start in one Context at a time;
            to continue a clone or an earlier state is an error, and so is a snapshot after the start.

    Raises:
        FileNotFoundError: There is no such file.
        FmuError: The FMU cannot be loaded, or fails when it is initialized.
        ModuleNotFoundError: FMPy is not installed, which the extra ``fmi`` installs.
        ValueError: The file is no FMU that can be simulated here, or a name, type or value does not fit.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        period: float | None = None,
        inputs: Sequence[str] | Mapping[str, str | Sequence[str]] | None = None,
        outputs: Sequence[str] | Mapping[str, str | Sequence[str]] | None = None,
        parameters: Mapping[str, ArrayLike | str] | None = None,
        fork: bool = True,
    ) -> None:
        super().__init__()
        fmu = ImportedFmu(path, fork=as_flag("FmuSystem: fork", fork))
        self._period = _period(fmu, period)
        ports_in, ports_out = fmu.ports("input", inputs), fmu.ports("output", outputs)
        numbers, texts = _start_values(fmu, parameters or {})
        self._instances = Instances(
            fmu,
            inputs=[variable for of in ports_in.values() for variable in of],
            outputs=[variable for of in ports_out.values() for variable in of],
            parameters=[variable for variable, _ in numbers],
            texts=texts,
            fork=fork,
        )
        self._parameters = self._declared_parameters(fmu, numbers)
        self._ports = [
            (self.DeclareVectorInputPort(port, entries.stop - entries.start), entries)
            for port, entries in _entries(ports_in).items()
        ]
        self._starts = np.concatenate([np.zeros(0), *(fmu.start(v) for of in ports_in.values() for v in of)])
        state = self.DeclareAbstractState(Value(_NOT_BEGUN))
        self.codecs = {0: _codec(fmu, fork=fork)}
        # Unrestricted updates come before discrete ones, which must still see the outputs before the step: so these are
        # discrete state. It is not addressed, because it is empty until the first step.
        size = sum(variable.size for of in ports_out.values() for variable in of)
        self._shown = self.declare_discrete_state(outputs=Quantity(np.zeros(size), addressed=False))
        prerequisites = {
            self.abstract_state_ticket(AbstractStateIndex(state)),
            self.discrete_state_ticket(self._shown.index),
            self.all_parameters_ticket(),
            self.time_ticket(),
        }
        self._outputs = self.declare_cache("outputs of the FMU", self._present_outputs, prerequisites)
        for port, entries in _entries(ports_out).items():
            self._declare_output(port, entries, prerequisites)
        self.DeclarePeriodicUnrestrictedUpdateEvent(self._period, 0.0, self._step)
        self.DeclarePeriodicDiscreteUpdateEvent(self._period, 0.0, self._show)
        # What fails, fails here.
        self._instances.initial(0.0, self._values_of(self.CreateDefaultContext()))

    def _declare_output(self, port: str, entries: slice, prerequisites: Any) -> None:
        def calc(system: FmuSystem, context: Context, output: Any) -> None:
            output.set_value(system._outputs(context)[entries])

        self.DeclareVectorOutputPort(port, entries.stop - entries.start, _method(self, calc), prerequisites)

    def _declared_parameters(
        self, fmu: ImportedFmu, numbers: Sequence[tuple[FmuVariable, np.ndarray]]
    ) -> ParameterGroup | None:
        quantities: dict[str, Quantity] = {}
        for variable, value in numbers:
            name = re.sub(r"\W", "_", variable.name)
            if name in quantities:
                raise ValueError(f"FmuSystem: two parameters of {fmu.name} have the address {name}: give one of them")
            default = value if variable.shape else value.item()
            quantities[name] = Quantity(default, variable.unit, fmu.bounds(variable))
        return self.declare_parameters(**quantities) if quantities else None

    def _values_of(self, context: Context) -> np.ndarray:
        return np.zeros(0) if self._parameters is None else self._parameters.array(context).copy()

    def _begun(self, context: Context) -> FmuState:
        """Return the state in a context; of one that has not begun, the state after the initialization."""
        state: FmuState = context.get_abstract_state(0).get_value()
        return state if state.begun else self._instances.initial(context.get_time(), self._values_of(context))

    def _present_outputs(self, context: Context) -> np.ndarray:
        if context.get_abstract_state(0).get_value().begun:
            return self._shown.array(context).copy()
        return self._begun(context).outputs

    def _step(self, context: Context, state: State) -> EventStatus:
        inputs = self._starts.copy()
        for port, entries in self._ports:
            if port.HasValue(context):
                inputs[entries] = port.Eval(context)
        time, present = context.get_time(), self._begun(context)
        following, is_end = self._instances.advanced(present, time, self._period, inputs, self._values_of(context))
        state.get_mutable_abstract_state(0).set_value(following)
        # At the first step they are not there yet.
        self._shown.mutable_array(state.get_mutable_discrete_state())[:] = present.outputs
        if is_end:
            return EventStatus.ReachedTermination(self, f"the FMU asks to end the simulation at t = {time:g} s")
        return EventStatus.Succeeded()

    def _show(self, context: Context, discrete_state: DiscreteValues) -> None:
        self._shown.mutable_array(discrete_state)[:] = context.get_abstract_state(0).get_value().outputs


def _method(system: FmuSystem, function: Any) -> Any:
    """Return a function as a method of a system, which `AddressedSystem` declares without keeping the system alive."""
    return function.__get__(system)


def _period(fmu: ImportedFmu, period: float | None) -> float:
    if period is None:
        period = fmu.proposed_step()
        if period is None:
            raise ValueError(f"{fmu.name} proposes no communication step: give period= in s")
    if not 0.0 < as_number("FmuSystem: period", period) < inf:
        raise ValueError(f"FmuSystem: period is positive and finite, in s, not {period}")
    return float(period)


def _start_values(
    fmu: ImportedFmu, parameters: Mapping[str, ArrayLike | str]
) -> tuple[list[tuple[FmuVariable, np.ndarray]], list[tuple[FmuVariable, str]]]:
    """Return the start values that are numbers, flat, and the ones that are texts."""
    numbers: list[tuple[FmuVariable, np.ndarray]] = []
    texts: list[tuple[FmuVariable, str]] = []
    for name, value in parameters.items():
        variable = fmu.parameter(name)
        if variable.dtype is None:
            if not isinstance(value, str):
                raise ValueError(f"FmuSystem: {name!r} of {fmu.name} is a text, not {value!r}")
            texts.append((variable, value))
            continue
        array = as_array(f"FmuSystem: {name!r} of {fmu.name}", value)
        if array.shape not in ((), variable.shape):
            raise ValueError(
                f"FmuSystem: {name!r} of {fmu.name} has the shape {variable.shape}, not {array.shape} as {value!r} has"
            )
        numbers.append((variable, np.array(np.broadcast_to(array, variable.shape), dtype=float)))
    return numbers, texts


def _entries(ports: Ports) -> dict[str, slice]:
    """Return the slice of each port in the array of all values."""
    entries, start = {}, 0
    for port, variables in ports.items():
        end = start + sum(variable.size for variable in variables)
        entries[port] = slice(start, end)
        start = end
    return entries


def _codec(fmu: ImportedFmu, *, fork: bool) -> Codec:
    codec = codec_of(_NOT_BEGUN)
    if fork:
        return codec

    def encode(value: Any) -> Mapping[str, np.ndarray]:
        if value.begun:
            raise ValueError(f"{fmu.name} cannot save its state (fork=False): take snapshots at the start only")
        return codec.encode(value)

    return Codec(encode, codec.decode)
