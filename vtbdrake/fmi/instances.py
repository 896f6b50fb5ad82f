"""The running instances of an FMU, which are scratch memory: its state is in the Context."""

from __future__ import annotations

import contextlib
import threading
import weakref
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from vtbdrake.common.arrays import Array, immutable
from vtbdrake.common.failures import one_line
from vtbdrake.fmi.extraction import ExtractionFolder
from vtbdrake.fmi.imported import FmuVariable, ImportedFmu

# Statuses of FMI 2 and 3.
_WARNING = 1
_FATAL = 4
# How many messages of an instance are kept for an error.
_MESSAGES = 5
# FMPy changes the current directory while it loads a library, and leaves it there if that fails.
_LOADING = threading.Lock()


class FmuError(RuntimeError):
    """A function of an FMU has failed."""


@immutable
class FmuState:
    """The state of an FMU at a communication point.

    Attributes:
        begun: Whether the FMU is initialized; else the rest is empty.
        data: Its serialized state; empty if it cannot be saved.
        parameters: The values of the parameters that it has, flat.
        outputs: The values of the outputs, flat.
    """

    begun: bool
    data: np.ndarray
    parameters: Array
    outputs: Array


class Values:
    """Reads and writes several variables of an instance as one array of floats.

    Args:
        variables: The variables, in the order of the array.
    """

    def __init__(self, variables: Sequence[FmuVariable]) -> None:
        ends = np.cumsum([0, *(variable.size for variable in variables)]).tolist()
        self.size: int = ends[-1]
        self._variables = variables
        self._entries = [slice(*ends[k : k + 2]) for k in range(len(variables))]
        # One call of the FMU for all variables of a type.
        self._by_type = {
            kind: [k for k, variable in enumerate(variables) if variable.type == kind]
            for kind in dict.fromkeys(variable.type for variable in variables)
        }

    def read(self, instance: Any) -> np.ndarray:
        """Return the values, flat, of an instance of FMPy."""
        values = np.empty(self.size)
        for kind, members in self._by_type.items():
            references = [self._variables[k].reference for k in members]
            count = sum(self._variables[k].size for k in members)
            sizes = () if kind in ("Real", "Integer") or not hasattr(instance, "getFloat64") else (count,)
            numbers = getattr(instance, f"get{kind}")(references, *sizes)
            start = 0
            for k in members:
                end = start + self._variables[k].size
                values[self._entries[k]] = numbers[start:end]
                start = end
        return values

    def write(self, instance: Any, values: np.ndarray) -> None:
        """Set the values in an instance of FMPy.

        Args:
            instance: The instance.
            values: The values of all variables, flat.

        Raises:
            ValueError: A value is none of its variable's type.
        """
        for kind, members in self._by_type.items():
            references = [self._variables[k].reference for k in members]
            numbers = [x for k in members for x in self._stored(self._variables[k], values[self._entries[k]])]
            getattr(instance, f"set{kind}")(references, numbers)

    def _stored(self, variable: FmuVariable, values: np.ndarray) -> list[Any]:
        if variable.dtype in (np.float64, np.float32):
            return values.tolist()
        limits = (0, 1) if variable.dtype is np.bool_ else (np.iinfo(variable.dtype).min, np.iinfo(variable.dtype).max)
        fits = (values == np.rint(values)) & (values >= limits[0]) & (values <= limits[1])
        if not fits.all():
            raise ValueError(
                f"{variable.name} is of the type {variable.type}, and takes whole numbers from {limits[0]} to "
                f"{limits[1]}, not {values[~fits][0]}"
            )
        return [bool(value) if variable.dtype is np.bool_ else int(value) for value in values]


class Instances:
    """The instances of an FMU: as many as threads use at once, each in one thread at a time.

    Args:
        fmu: The FMU.
        inputs, outputs, parameters: The variables that are set and read.
        texts: Texts that are set before the initialization: (variable, text).
        fork: Whether the state is saved after each step; else there is one instance, whose state is nowhere else.
    """

    def __init__(
        self,
        fmu: ImportedFmu,
        *,
        inputs: Sequence[FmuVariable],
        outputs: Sequence[FmuVariable],
        parameters: Sequence[FmuVariable],
        texts: Sequence[tuple[FmuVariable, str]],
        fork: bool,
    ) -> None:
        self._fmu, self._texts, self.fork = fmu, texts, fork
        self._inputs, self._outputs, self._parameters = Values(inputs), Values(outputs), Values(parameters)
        self._is_tunable = np.array([v.is_tunable for v in parameters for _ in range(v.size)], dtype=bool)
        self._names = [v.name for v in parameters for _ in range(v.size)]
        self._tunables = Values([v for v in parameters if v.is_tunable])
        self._folder = ExtractionFolder()
        self._all: list[_Instance] = []
        self._idle: list[_Instance] = []
        self._most = 1 if fmu.once or not fork else None
        self._change = threading.Condition()
        weakref.finalize(self, _end, self._all, self._folder)
        fmu.fmpy.extract(str(fmu.path), self._folder.path)
        self._initial: tuple[tuple[float, bytes], FmuState] | None = None

    def initial(self, time: float, parameters: np.ndarray) -> FmuState:
        """Return the state of the FMU after its initialization.

        Args:
            time: The time at which it begins, in s.
            parameters: The values of the parameters, flat.

        Raises:
            FmuError: The FMU refuses.
            ValueError: A value is none of its variable's type.
        """
        key = time, parameters.tobytes()
        last = self._initial
        if last is not None and last[0] == key and (self.fork or any(i.holds is last[1] for i in self._all)):
            return last[1]
        with self._used(None) as instance, self._explained(instance, time):
            instance.begin(time, lambda slave: self._start(slave, parameters))
            state = self._state_of(instance, parameters)
        self._initial = key, state
        return state

    def advanced(
        self, state: FmuState, time: float, step: float, inputs: np.ndarray, parameters: np.ndarray
    ) -> tuple[FmuState, bool]:
        """Return the state after a step, and whether the FMU asks to end the simulation.

        Args:
            state: The state before the step, which has begun.
            time: The time of the state in s.
            step: The length of the step in s.
            inputs: The values of the inputs during the step, flat.
            parameters: The values of the parameters, flat.

        Raises:
            FmuError: The FMU fails, or its state is gone.
            ValueError: A value is none of its variable's type, or a parameter cannot change any more.
        """
        changed = state.parameters != parameters
        if (changed & ~self._is_tunable).any():
            name = self._names[int(np.flatnonzero(changed & ~self._is_tunable)[0])]
            raise ValueError(
                f"the parameter {name} of {self._fmu.name} is fixed, and cannot change once the FMU has begun: set it "
                "before the simulation begins"
            )
        with self._used(state) as instance, self._explained(instance, time):
            if instance.holds is not state:
                self._restore(instance, state)
            if changed.any():
                instance.holds = None
                self._tunables.write(instance.slave, parameters[self._is_tunable])
            self._inputs.write(instance.slave, inputs)
            instance.holds = None
            is_end = instance.step(time, step)
            return self._state_of(instance, parameters), is_end

    def _start(self, slave: Any, parameters: np.ndarray) -> None:
        self._parameters.write(slave, parameters)
        for variable, text in self._texts:
            slave.setString([variable.reference], [text])

    def _state_of(self, instance: _Instance, parameters: np.ndarray) -> FmuState:
        data = instance.save() if self.fork else np.zeros(0, np.uint8)
        state = FmuState(True, data, parameters.copy(), self._outputs.read(instance.slave))
        instance.holds = state
        return state

    def _restore(self, instance: _Instance, state: FmuState) -> None:
        if not self.fork:
            raise FmuError(
                f"{self._fmu.name} has gone on from this state, to which it cannot return (fork=False): simulate from "
                "the start, or build another testbed"
            )
        instance.load(state.data)

    @contextlib.contextmanager
    def _explained(self, instance: _Instance, time: float) -> Iterator[None]:
        """Turn an error of FMPy's into one that names the time and what the FMU has logged."""
        instance.messages.clear()
        try:
            yield
        except self._fmu.fmpy.fmi1.FMICallException as error:
            self._drop(instance, fatal=error.status == _FATAL)
            said = "; ".join(instance.messages) or "it logs nothing"
            raise FmuError(
                f"{self._fmu.name} fails at t = {time:g} s: {one_line(error).rstrip('.')}: {said}"
            ) from error

    @contextlib.contextmanager
    def _used(self, state: FmuState | None) -> Iterator[_Instance]:
        instance = self._taken(state)
        try:
            yield instance
        finally:
            with self._change:
                if instance in self._all:
                    self._idle.append(instance)
                self._change.notify()

    def _taken(self, state: FmuState | None) -> _Instance:
        """Return an instance that nobody uses, which holds a state if one does."""
        with self._change:
            while not self._idle and self._most is not None and len(self._all) >= self._most:
                self._change.wait()
            holders = [instance for instance in self._idle if instance.holds is state]
            if holders or self._idle:
                instance = (holders or self._idle)[0]
                self._idle.remove(instance)
            else:
                instance = _Instance(self._fmu, self._folder.path)
                self._all.append(instance)
            return instance

    def _drop(self, instance: _Instance, *, fatal: bool) -> None:
        """Forget an instance that has failed; after a fatal error, none of its functions may be called."""
        with self._change:
            self._all.remove(instance)
        if not fatal:
            instance.free()


class _Instance:
    """One instance of FMPy.

    Attributes:
        slave: The instance of FMPy.
        holds: The state that it has, if it is one in a Context.
        messages: The last messages that it has logged.
    """

    def __init__(self, fmu: ImportedFmu, folder: str) -> None:
        self.holds: FmuState | None = None
        self.messages: deque[str] = deque(maxlen=_MESSAGES)
        self._is_fmi2, self._has_begun = fmu.is_fmi2, False
        messages = self.messages

        def log(*arguments: Any) -> None:
            status, _, message = arguments[-3:]
            if status >= _WARNING and message:
                messages.append(" ".join(message.decode(errors="replace").split()))

        try:
            with _LOADING, contextlib.chdir("."):
                self.slave = fmu.fmpy.simulation.instantiate_fmu(
                    folder, fmu.description, "CoSimulation", logger=log, debug_logging=True
                )
        except Exception as error:  # FMPy raises plain exceptions.
            said = "; ".join(messages)
            raise FmuError(f"{fmu.name} cannot be loaded: {one_line(error)}{said and f': {said}'}") from error

    def begin(self, time: float, start: Any) -> None:
        """Initialize the instance, again if it has been before.

        Args:
            time: The time in s.
            start: Function of the instance of FMPy that sets the start values.
        """
        self.holds = None
        if self._has_begun:
            self.slave.reset()
        self._has_begun = True
        if self._is_fmi2:
            self.slave.setupExperiment(startTime=time)
            start(self.slave)
            self.slave.enterInitializationMode()
        else:
            start(self.slave)
            self.slave.enterInitializationMode(startTime=time)
        self.slave.exitInitializationMode()

    def step(self, time: float, step: float) -> bool:
        """Do a step; return whether the FMU asks to end the simulation."""
        result = self.slave.doStep(currentCommunicationPoint=time, communicationStepSize=step)
        return False if self._is_fmi2 else bool(result[1])

    def save(self) -> np.ndarray:
        """Return the serialized state."""
        state = self.slave.getFMUState()
        try:
            return np.frombuffer(self.slave.serializeFMUState(state), np.uint8)
        finally:
            self.slave.freeFMUState(state)

    def load(self, data: np.ndarray) -> None:
        """Continue from a serialized state."""
        if not self._has_begun:
            # Some FMUs restore a state only when they have been initialized.
            self.begin(0.0, lambda slave: None)
        state = self.slave.deserializeFMUState(data.tobytes())
        try:
            self.slave.setFMUState(state)
        finally:
            self.slave.freeFMUState(state)

    def free(self) -> None:
        """Free the instance."""
        with contextlib.suppress(Exception):  # An FMU may refuse to terminate in the state in which it is.
            self.slave.terminate()
        self.slave.freeInstance()


def _end(instances: list[_Instance], folder: ExtractionFolder) -> None:
    for instance in instances:
        with contextlib.suppress(Exception):
            instance.free()
    folder.remove()
