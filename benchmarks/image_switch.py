"""Benchmark of the switch of an image signal, which is a system in Python."""

from __future__ import annotations

import time
from functools import partial

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource, ZeroOrderHold
from pydrake.systems.sensors import ImageRgba8U

from benchmarks.measure import LOWER, Benchmark, interleaved_values, spread
from vtbdrake.testbed import Interface, Signal, VirtualTestbedBuilder

PERIOD, IMAGE = 0.001, ImageRgba8U(320, 240)


def image_switch(repeats: int = 7, images: int = 1000) -> Benchmark:
    """Microseconds that an image of 320 x 240 pixels takes to pass T_sense.

    A sensor in C++ shows a new image in every period, and a DPS in C++ samples it. This simulation is compared with the
    same systems without a switch. The switch holds Python's interpreter lock during this time.
    """
    builder = VirtualTestbedBuilder(Interface(sense=[Signal("image", model_value=IMAGE)], act=[]))
    builder.sim_sensor("image", _camera(builder.diagram_builder).get_output_port())
    builder.set_dps(_dps())
    by_hand = DiagramBuilder()
    by_hand.Connect(_camera(by_hand).get_output_port(), by_hand.AddSystem(_dps()).get_input_port())
    switched, direct = Simulator(builder.build().diagram), Simulator(by_hand.Build())
    times = interleaved_values(partial(_advance, switched, images), partial(_advance, direct, images), repeats=repeats)
    ours, theirs = (1e6 * values / images for values in times)
    return Benchmark(
        name="image_switch",
        value=float(np.median(ours) - np.median(theirs)),
        unit="us",
        goal=None,
        better=LOWER,
        against="the same systems without a switch",
        note=f"CPU time per period {spread(ours, unit='us')} with a switch, {spread(theirs, unit='us')} without",
    )


def _camera(builder: DiagramBuilder) -> ZeroOrderHold:
    source = builder.AddSystem(ConstantValueSource(Value(IMAGE)))
    camera = builder.AddSystem(ZeroOrderHold(PERIOD, Value(IMAGE)))
    builder.Connect(source.get_output_port(), camera.get_input_port())
    return camera


def _dps() -> Diagram:
    builder = DiagramBuilder()
    hold = builder.AddNamedSystem("hold", ZeroOrderHold(PERIOD, Value(IMAGE)))
    builder.ExportInput(hold.get_input_port(), "image")
    return builder.Build()


def _advance(simulator: Simulator, images: int) -> float:
    begin = time.thread_time()
    simulator.AdvanceTo(simulator.get_context().get_time() + images * PERIOD)
    return time.thread_time() - begin
