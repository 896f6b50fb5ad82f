"""Calibration of raw sensor values, the first part of a DPS."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import Adder, ConstantVectorSource, Demultiplexer, Multiplexer

from vtbdrake.state.declarations import PARAMETER, Element


def make_calibration(signals: Mapping[str, int], *, largest: Mapping[str, float] | None = None) -> Diagram:
    """Return a system that adds the parameter ``offset`` to raw values; each signal is an input and an output port.

    Args:
        signals: The sizes of the vector signals, by name.
        largest: The largest offset of a signal, in its unit; without one, any.
    """
    builder, sizes = DiagramBuilder(), list(signals.values())
    raw = builder.AddNamedSystem("raw", Multiplexer(sizes))
    offset = builder.AddNamedSystem("offset", ConstantVectorSource(np.zeros(sum(sizes))))
    most = np.concatenate([np.full(size, (largest or {}).get(name, np.inf)) for name, size in signals.items()])
    offset.variables = (Element("value", PARAMETER, 0, most.shape, bounds=(-most, most)),)
    measured = builder.AddNamedSystem("measured", Adder(2, sum(sizes)))
    split = builder.AddNamedSystem("split", Demultiplexer(sizes))
    builder.Connect(raw.get_output_port(), measured.get_input_port(0))
    builder.Connect(offset.get_output_port(), measured.get_input_port(1))
    builder.Connect(measured.get_output_port(), split.get_input_port())
    for k, signal in enumerate(signals):
        builder.ExportInput(raw.get_input_port(k), signal)
        builder.ExportOutput(split.get_output_port(k), signal)
    return builder.Build()
