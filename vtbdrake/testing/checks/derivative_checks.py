"""A check of derivatives, where systems in Python are declared for AutoDiff."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff
from pydrake.systems.framework import Context, PortDataType, System

from vtbdrake.common.failures import FAILURES, error_text
from vtbdrake.state.declarations import CONTINUOUS, DISCRETE, PARAMETER
from vtbdrake.state.systems import is_python, leaves, read_group, stateful_leaves, write_group
from vtbdrake.testing.subject import CheckFailedError, CheckSkippedError, Subject

# Pytest shows none of the frames of this module: what a check has found is its message.
__tracebackhide__ = True

_STEPS = (1e-6, 1e-7)  # of differences, relative to the value
_TOLERANCE = 1e-4  # of a derivative, relative to the largest one of its row


def check_derivatives_are_right(subject: Subject) -> None:
    """Check that derivatives of Python systems by AutoDiff equal those by finite differences.

    Gradients of a whole rollout are made of them. A system that converts, but computes with plain numbers inside
    (ExtractValue, float), has derivatives of zero: keep the type of what comes in, or do not declare it for AutoDiff.
    """
    testbed = subject.testbed
    context = subject.started(testbed)
    testbed.simulator(context).AdvanceTo(float(subject.instants[len(subject.instants) // 2]))
    groups = {leaf.path: leaf.groups for leaf in stateful_leaves(testbed.diagram)}
    checked = False
    for path, system in leaves(testbed.diagram):
        if not is_python(system):
            continue
        try:
            converted = system.ToAutoDiffXd()
        except RuntimeError:
            continue  # It does not declare AutoDiff.
        checked = True
        point = _Point(system, system.GetMyContextFromRoot(context), groups[path])
        try:
            _compare(path, point, converted)
        except CheckFailedError:
            raise
        except FAILURES as error:
            raise CheckFailedError(
                f"{path} converts to AutoDiffXd, but does not compute: {error_text(error)}"
            ) from error
    if not checked:
        raise CheckSkippedError("no system in Python converts to AutoDiffXd")


class _Point:
    """The inputs, state and parameters of a system: x is what its outputs are derived by."""

    def __init__(self, system: System, context: Context, groups: Any) -> None:
        self.system = system
        self._alone = system.CreateDefaultContext()
        ports = [system.get_input_port(index) for index in range(system.num_input_ports())]
        ports = [port for port in ports if port.HasValue(context)]
        vectors = [port for port in ports if port.get_data_type() == PortDataType.kVectorValued]
        self.inputs = {int(port.get_index()): np.array(port.Eval(context)) for port in vectors}
        self.abstract = {
            int(port.get_index()): system.EvalAbstractInput(context, port.get_index())
            for port in ports
            if port not in vectors
        }
        numbers = {(g.kind, g.number): read_group(context, g.kind, g.number) for g in groups}
        self.parameters = {key: value for key, value in numbers.items() if key[0] == PARAMETER}
        self.states = {key: value for key, value in numbers.items() if key[0] != PARAMETER}
        self.x = np.concatenate([np.zeros(0), *self.inputs.values(), *self.states.values()])

    def name(self, k: int) -> str:
        """Return the name of entry k of x."""
        ports = {self.system.get_input_port(i).get_name(): value.size for i, value in self.inputs.items()}
        groups = {f"{kind} group {number}": value.size for (kind, number), value in self.states.items()}
        for name, size in {**ports, **groups}.items():
            if k < size:
                return f"{name}[{k}]"
            k -= size
        raise IndexError(k)

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return the results of the system at x, in one array."""
        results = self.results(self.system, self._alone, x, np.asarray)
        return np.concatenate([np.zeros(0), *(values for _, values in results)])

    def results(self, system: Any, context: Any, x: Any, constant: Any) -> Iterator[tuple[str, Any]]:
        """Yield what ``system``, of the scalar type of ``x``, computes in a context of its own.

        ``constant`` makes its type of numbers.
        """
        start = 0
        for index, value in self.inputs.items():
            system.get_input_port(index).FixValue(context, x[start : start + value.size])
            start += value.size
        for index, value in self.abstract.items():
            system.get_input_port(index).FixValue(context, value)
        for (kind, number), value in self.states.items():
            write_group(context, kind, number, x[start : start + value.size])
            start += value.size
        for (kind, number), value in self.parameters.items():
            write_group(context, kind, number, constant(value))
        for index in range(system.num_output_ports()):
            port = system.get_output_port(index)
            if port.get_data_type() == PortDataType.kVectorValued:
                yield port.get_name(), np.array(port.Eval(context))
        if any(kind == CONTINUOUS for kind, _ in self.states):
            yield "its time derivatives", system.EvalTimeDerivatives(context).CopyToVector()
        if any(kind == DISCRETE for kind, _ in self.states) and system.GetUniquePeriodicDiscreteUpdateAttribute():
            update = system.EvalUniquePeriodicDiscreteUpdate(context)
            for index in range(update.num_groups()):
                yield "its discrete update", update.get_vector(index).CopyToVector()


def _compare(path: str, point: _Point, converted: Any) -> None:
    count = point.x.size
    if not count:
        return
    seeded = InitializeAutoDiff(point.x).ravel()
    context = converted.CreateDefaultContext()
    exact = list(
        point.results(converted, context, seeded, lambda v: InitializeAutoDiff(v, np.zeros((v.size, count))).ravel())
    )
    here = point.values(point.x)
    expected = np.stack([_slopes(point, here, k) for k in range(count)], axis=1)
    row = 0
    for name, values in exact:
        gradient = ExtractGradient(values.reshape(-1, 1))
        gradient = gradient if gradient.size else np.zeros((values.size, count))
        rows = expected[row : row + values.size]
        row += values.size
        scale = np.maximum(1.0, np.nan_to_num(np.abs(rows)).max(axis=1, keepdims=True))
        errors = np.nan_to_num(np.abs(gradient - rows) / scale)
        if errors.max(initial=0.0) > _TOLERANCE:
            i, k = map(int, np.unravel_index(np.argmax(errors), errors.shape))
            raise CheckFailedError(
                f"{path}: the derivative of {name}[{i}] by {point.name(k)} is {gradient[i, k]:g} by AutoDiff, "
                f"{rows[i, k]:g} by differences"
            )


def _slopes(point: _Point, here: np.ndarray, k: int) -> np.ndarray:
    """Return the derivatives of all results, which are ``here`` at x, by entry k of x; NaN at a kink or a jump."""
    slopes = []
    for size in _STEPS:
        for sign in (1.0, -1.0):
            step = np.zeros(point.x.size)
            step[k] = sign * size * max(1.0, abs(point.x[k]))
            slopes.append((point.values(point.x + step) - here) / step[k])
    mean = np.mean(slopes[:2], axis=0)
    return np.where(np.isclose(slopes, mean, rtol=1e-3, atol=_TOLERANCE).all(axis=0), mean, np.nan)
