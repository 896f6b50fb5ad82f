"""Costs of an estimator and a controller in CasADi, against numpy."""

from __future__ import annotations

from functools import partial

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, System
from pydrake.systems.primitives import ConstantVectorSource, Sine, TrajectorySource, ZeroOrderHold
from pydrake.trajectories import PiecewisePolynomial

from benchmarks.impedance import NumpyImpedance, casadi_impedance
from benchmarks.measure import LOWER, Benchmark, interleaved, ratio
from benchmarks.range_filter import PERIOD, NumpyFilter, casadi_filter, measurements

TOLERANCE = 1e-12


def casadi_system(repeats: int = 11, ticks: int = 1000) -> list[Benchmark]:
    """Time per tick of a simulation with a numpy system, and with the same in CasADi, interpreted and compiled.

    All of a tick counts: Drake's event, reading the inputs, computing, writing the result.
    """
    z = measurements(ticks + 1)
    cases = (
        ("casadi_system", "estimator", NumpyFilter, casadi_filter, partial(_filtering, z=z)),
        ("casadi_system_impedance", "controller", NumpyImpedance, casadi_impedance, _controlling),
    )
    results = []
    for name, system, by_hand, ours, simulator in cases:
        for suffix, compile in (("", False), ("_compiled", True)):
            a, b = simulator(ours(compile=compile)), simulator(by_hand())
            difference = _largest_difference(a, b, ticks)
            if not difference <= TOLERANCE:
                raise ArithmeticError(f"{name}{suffix}: CasADi and numpy come out {difference:.2g} apart")
            times, theirs = interleaved(partial(_run, a, ticks), partial(_run, b, ticks), repeats=repeats)
            micros = [f"{1e6 * np.median(t) / ticks:.1f}" for t in (times, theirs)]
            results.append(
                Benchmark(
                    name=f"{name}{suffix}",
                    value=ratio(times, theirs),
                    unit="1",
                    goal=None if results else 0.3,
                    better=LOWER,
                    against=f"the same {system} in numpy",
                    note=f"{micros[0]} and {micros[1]} us per tick, n = {repeats}; results {difference:.1g} apart",
                )
            )
    return results


def _run(simulator: Simulator, ticks: int) -> None:
    _reset(simulator)
    simulator.AdvanceTo(ticks * PERIOD)


def _reset(simulator: Simulator) -> None:
    context = simulator.get_mutable_context()
    simulator.get_system().SetDefaultContext(context)
    context.SetTime(0.0)
    simulator.Initialize()


def _largest_difference(a: Simulator, b: Simulator, ticks: int) -> float:
    """Between the discrete states after each tick, relative to the largest entry of each group."""
    _reset(a)
    _reset(b)
    largest = 0.0
    for k in range(ticks):
        for simulator in (a, b):
            simulator.AdvanceTo((k + 0.5) * PERIOD)
        for i in range(a.get_context().num_discrete_state_groups()):
            ours, theirs = (s.get_context().get_discrete_state(i).value() for s in (a, b))
            largest = max(largest, float(np.max(np.abs(ours - theirs)) / np.max(np.abs(theirs))))
    return largest


def _filtering(system: System, z: np.ndarray) -> Simulator:
    times = PERIOD * np.arange(z.shape[1])
    builder = DiagramBuilder()
    builder.AddSystem(system)
    source = builder.AddSystem(TrajectorySource(PiecewisePolynomial.FirstOrderHold(times, z)))
    builder.Connect(source.get_output_port(), system.GetInputPort("z"))
    return Simulator(builder.Build())


def _controlling(system: System) -> Simulator:
    builder = DiagramBuilder()
    builder.AddSystem(system)
    ones, phases = np.ones(7), np.arange(7.0)
    motion = builder.AddSystem(Sine(0.5 * ones, 1.0 + 0.1 * phases, phases))
    target = builder.AddSystem(ConstantVectorSource([0.5, 0.1, 0.4]))
    hold = builder.AddSystem(ZeroOrderHold(PERIOD, 7))
    builder.Connect(motion.get_output_port(0), system.GetInputPort("q"))
    builder.Connect(motion.get_output_port(1), system.GetInputPort("v"))
    builder.Connect(target.get_output_port(), system.GetInputPort("target"))
    builder.Connect(system.get_output_port(), hold.get_input_port())
    return Simulator(builder.Build())
