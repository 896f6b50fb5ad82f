"""Replay of the DPS alone by systems in C++, which feed it and keep its commands: no call from Python per cycle."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from pydrake.systems.analysis import InitializeParams, Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, TriggerType
from pydrake.systems.primitives import Demultiplexer, TrajectorySource, VectorLogSink
from pydrake.trajectories import DiscreteTimeTrajectory

from vtbdrake.recording.control_log import ControlLog
from vtbdrake.testbed import DpsAlone

_LONGEST = 250  # cycles of a stretch: a source looks through all its samples
_TOLERANCE = 1e-9  # s, of the time of a sample


class SourcesError(RuntimeError):
    """A DPS that cannot be fed in this way: it has to be stepped cycle by cycle."""


class Sources:
    """Feeds the recorded sensor values to a DPS, stretch by stretch, and keeps what it commands.

    A value is there at the time of its cycle's beginning, to the sample, and at no other: a DPS that looks at its
    inputs at another time raises. Commands are looked at where a cycle ends, before what is updated at that time.

    Args:
        log: what is fed.
        target: becomes part of `diagram`; it is nobody else's from now on.

    Attributes:
        diagram: the target's within, and the sources.

    Raises:
        SourcesError: a signal is abstract, the DPS has continuous state, or its commands follow from what its sensors
            say at the same time.
    """

    def __init__(self, log: ControlLog, target: DpsAlone) -> None:
        interface, inner = target.interface, target.diagram
        if not all(signal.is_vector for signal in (*interface.sense, *interface.act)) or not interface.sense:
            raise SourcesError("not all signals are vectors, or no sensor is there")
        sense = [inner.GetInputPort(f"real.sense.{signal.name}") for signal in interface.sense]
        act = {signal.name: inner.GetOutputPort(f"real.act.{signal.name}") for signal in interface.act}
        if any(inner.HasDirectFeedthrough(i.get_index(), o.get_index()) for i in sense for o in act.values()):
            raise SourcesError("the commands follow directly from what the sensors say")
        sizes = [port.size() for port in sense]
        self._values = np.hstack([log.fed[signal.name] for signal in interface.sense])
        self._names = [signal.name for signal in interface.sense]
        self._log = log
        builder = DiagramBuilder()
        builder.AddSystem(inner)
        nothing = DiscreteTimeTrajectory([0.0], [np.zeros((sum(sizes), 1))])
        self._source = builder.AddSystem(TrajectorySource(nothing))
        split = builder.AddSystem(Demultiplexer(sizes))
        builder.Connect(self._source.get_output_port(), split.get_input_port())
        for i, port in enumerate(sense):
            builder.Connect(split.get_output_port(i), port)
        self._sinks = {}
        for name, output in act.items():
            self._sinks[name] = builder.AddSystem(VectorLogSink(output.size(), {TriggerType.kPerStep}, 0.0))
            builder.Connect(output, self._sinks[name].get_input_port())
        self.diagram: Diagram = builder.Build()
        if self.diagram.CreateDefaultContext().num_continuous_states():
            raise SourcesError("the DPS has continuous state")

    def simulator(self, context: Context, *, restored: bool) -> Simulator:
        """Of `diagram`, from ``context`` on; see `AddressedDiagram.simulator`."""
        simulator = Simulator(self.diagram, context)
        if restored:
            simulator.Initialize(InitializeParams(suppress_initialization_events=True))
        return simulator

    def complete_from(self, i: int) -> bool:
        """Whether every sensor signal has a value in cycle ``i``."""
        return all(bool(self._log.sources[name][: i + 1].any()) for name in self._names)

    def advance(self, simulator: Simulator, first: int, end: int, times: np.ndarray) -> None:
        """Does the cycles ``first`` to ``end`` - 1; ``times`` are those at which they begin and end."""
        ends = [*range(first, end, _LONGEST), end]
        for a, b in pairwise(ends):
            begins = times[a - first : b - first].tolist()
            self._source.UpdateTrajectory(
                DiscreteTimeTrajectory(begins, list(self._values[a:b, :, np.newaxis]), _TOLERANCE)
            )
            simulator.AdvanceTo(times[b - first])

    def commands(self, context: Context, times: np.ndarray) -> Mapping[str, np.ndarray]:
        """What the DPS commanded at the ends of cycles, by signal.

        Raises:
            SourcesError: at one of them it was not looked at.
        """
        found: dict[str, Any] = {}
        for name, sink in self._sinks.items():
            kept = sink.FindLog(context)
            where = np.minimum(np.searchsorted(kept.sample_times(), times), kept.num_samples() - 1)
            if not np.array_equal(kept.sample_times()[where], times):
                raise SourcesError("its steps do not end where cycles do")
            found[name] = kept.data().T[where]
        return found
