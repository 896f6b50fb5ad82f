"""Derivatives of a rollout: of its states by AutoDiff, and of its quality along the directions of the states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.geometry import SceneGraph
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator_
from pydrake.systems.framework import Context

from vtbdrake.common.argument_checks import as_result
from vtbdrake.drake_workarounds.lost_interrupts import Interruptible
from vtbdrake.rollout.quality import READINGS, Quality
from vtbdrake.rollout.task import RolloutTask
from vtbdrake.state.systems import leaves, read_group, stateful_leaves, write_group
from vtbdrake.testbed import VirtualTestbed

# Relative step of a parameter in the differences of the context's groups, which are mostly linear in it.
_STEP = 1e-6
# Step of the state, along its derivative by a parameter, in the differences of f.
_NUDGE = 1e-6


class DerivativeError(ValueError):
    """A testbed or a problem has no derivative that can be computed."""


class DerivativeRunner:
    """Runs rollouts, and computes the derivatives of their quality with respect to the parameters.

    The simulation runs once with AutoDiffXd, at fixed steps: with error control the steps would depend on the
    parameters, and the derivatives would be wrong. At the sample times the state and its derivatives ds/dp are known; f
    is evaluated at s +- e ds/dp, so that f may be any function in Python.

    Args:
        task: The task. Its threshold is ignored.
        testbed: A testbed of the task's scenario, whose systems convert to AutoDiffXd.

    Raises:
        DerivativeError: A system does not convert, or the integrator controls its error.
    """

    def __init__(self, task: RolloutTask, testbed: VirtualTestbed) -> None:
        if task.quality is None:
            raise DerivativeError("a rollout without a quality has no derivative")
        self.task = task
        self.testbed = testbed
        self._quality: Quality = task.quality
        fields = testbed.simulator_config
        discrete = testbed.plant is not None and testbed.plant.time_step() > 0.0
        if fields.use_error_control and not discrete:
            raise DerivativeError(
                f"derivatives need fixed steps, but {fields.integration_scheme} controls its error: set "
                "simulator_config.use_error_control to false and choose max_step_size, or use gradient='central'"
            )
        try:
            self._diagram = testbed.diagram.ToAutoDiffXd()
        except RuntimeError as error:
            raise DerivativeError(
                f"the testbed does not convert to AutoDiffXd: {error}. Use gradient='central'"
            ) from error
        converted = dict(leaves(self._diagram))
        self._pairs = [
            (leaf, converted[leaf.path])
            for leaf in stateful_leaves(testbed.diagram)
            if not isinstance(leaf.system, SceneGraph)
        ]
        self._readers = [testbed.reader(address) for address in self._quality.of]

    def run(self, parameters: Mapping[str, Any], by: Sequence[str]) -> tuple[float, np.ndarray]:
        """Run one rollout with derivatives.

        Args:
            parameters: Address -> value, set in s0.
            by: Addresses of the n parameters with respect to which the derivatives are taken.

        Returns:
            The reading of the quality, and its derivatives, shape (n,).

        Raises:
            DerivativeError: A parameter is not part of the numeric groups of the context.
            RuntimeError: The simulation fails.
        """
        context = self._start(parameters)
        directions = {address: self._direction(parameters, address) for address in by}
        simulator = Simulator_[AutoDiffXd](self._diagram, self._seeded(context, list(directions.values())))
        ApplySimulatorConfig(self.testbed.simulator_config, simulator)
        simulator.set_target_realtime_rate(0.0)
        simulator.get_mutable_context().SetTime(AutoDiffXd(context.get_time()))
        t0 = context.get_time()
        samples, slopes, times = [], [], self.task.sample_times()
        for instant in self.task.instants(t0, self.testbed.event_timings()).tolist():
            with Interruptible():
                if instant > t0:
                    simulator.AdvanceTo(AutoDiffXd(instant))
                value, slope = self._sample(simulator.get_context(), context, instant, len(by))
            samples.append(value)
            slopes.append(slope)
        return self._read(times, np.array(samples), np.array(slopes))

    def _start(self, parameters: Mapping[str, Any]) -> Context:
        context = self.testbed.default_context()
        if self.task.start is not None:
            self.testbed.restore(context, self.task.start)
            self.testbed.switch(context, "sim")
        self.testbed.write(context, parameters)
        return context

    def _direction(self, parameters: Mapping[str, Any], address: str) -> dict[tuple[str, str, int], np.ndarray]:
        """Return the change of the numeric groups by writing a parameter: a central difference."""
        variable = self.testbed.variables()[address]
        if variable.carried_by:
            raise DerivativeError(
                f"{address} does not lie in the numeric groups of the context, through which derivatives are taken: "
                "use gradient='central'"
            )
        value = float(parameters[address])
        step = _STEP * max(1.0, abs(value))
        lower, upper = (float(np.asarray(bound)) for bound in variable.bounds)
        ends = max(value - step, lower), min(value + step, upper)
        below, above = (self._groups(self._start({**parameters, address: end})) for end in ends)
        return {key: (above[key] - below[key]) / (ends[1] - ends[0]) for key in below}

    def _groups(self, context: Context) -> dict[tuple[str, str, int], np.ndarray]:
        return {
            (path, kind, index): read_group(system.GetMyContextFromRoot(context), kind, index)
            for (path, system, groups), _ in self._pairs
            for kind, index, _ in groups
        }

    def _seeded(self, context: Context, directions: Sequence[Mapping[tuple[str, str, int], np.ndarray]]) -> Any:
        seeded = self._diagram.CreateDefaultContext()
        seeded.SetTimeStateAndParametersFrom(context)
        systems = {leaf.path: converted for leaf, converted in self._pairs}
        for (path, kind, index), value in self._groups(context).items():
            gradient = np.stack([direction[path, kind, index] for direction in directions], axis=1)
            # NaN means no value, such as no command: it has no derivative.
            gradient[np.isnan(gradient)] = 0.0
            if gradient.any():
                leaf_context = systems[path].GetMyMutableContextFromRoot(seeded)
                write_group(leaf_context, kind, index, InitializeAutoDiff(value, gradient).ravel())
        return seeded

    def _sample(self, seeded: Any, context: Context, t: float, count: int) -> tuple[float, np.ndarray]:
        context.SetTime(t)
        values, gradients = {}, {}
        for leaf, converted in self._pairs:
            for kind, index, _ in leaf.groups:
                entries = read_group(converted.GetMyContextFromRoot(seeded), kind, index)
                key = (leaf.path, kind, index)
                values[key] = ExtractValue(entries).ravel()
                gradient = ExtractGradient(entries)
                gradients[key] = gradient if gradient.size else np.zeros((values[key].size, count))
        self._write(context, values)
        sample = self._f(context, t)
        slope = np.empty(count)
        for k in range(count):
            ends = []
            scale = max((float(np.abs(g[:, k]).max(initial=0.0)) for g in gradients.values()), default=0.0)
            nudge = _NUDGE / max(1.0, scale)
            for sign in (1.0, -1.0):
                self._write(context, {key: v + sign * nudge * gradients[key][:, k] for key, v in values.items()})
                ends.append(self._f(context, t, checked=False))
            slope[k] = (ends[0] - ends[1]) / (2.0 * nudge)
        return sample, slope

    def _write(self, context: Context, values: Mapping[tuple[str, str, int], np.ndarray]) -> None:
        for (path, system, groups), _ in self._pairs:
            leaf_context = system.GetMyMutableContextFromRoot(context)
            for kind, index, _ in groups:
                write_group(leaf_context, kind, index, values[path, kind, index])

    def _f(self, context: Context, t: float, *, checked: bool = True) -> float:
        arguments = [read(context) for read in self._readers]
        # A step may make f negative.
        return self._quality(arguments, time=t) if checked else as_result(self._quality.f(*arguments))

    def _read(self, times: np.ndarray, samples: np.ndarray, slopes: np.ndarray) -> tuple[float, np.ndarray]:
        t, value = READINGS[self._quality.reading](times, samples, not self._quality.minimize)
        if self._quality.reading == "integral":
            return float(value), np.trapezoid(slopes, times, axis=0)
        # Envelope theorem: at the best time f is stationary in time, or the time is an end.
        return float(value), slopes[int(np.flatnonzero(times == t)[0])]
