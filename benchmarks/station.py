"""A station from its file against Drake's hardware_sim loop on the same file."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from drake import lcmt_schunk_wsg_command
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from benchmarks import hardware_sim_loop
from benchmarks.measure import LOWER, Benchmark, spread
from vtbdrake.station import Station
from vtbdrake_diagrams.station import FILE, HOME

OPENING, FORCE = 0.1, 40.0
CHUNK, CHUNKS = 0.1, 10  # s


def station_overhead(repeats: int = 10) -> list[Benchmark]:
    """Processor time of simulated seconds: the arm holds torques or positions, and the gripper opens.

    Both have the same systems and take the same steps to the same states, bit for bit. They run in turns of 0.1 s, and
    are built in alternating order, as `testbed_overhead` is measured. The arm's driver has no LCM bus in either; the
    gripper's has one in Drake, which adds its messages to the arithmetic.
    """
    return [
        _overhead("station_overhead", "Torque", repeats),
        _overhead("station_overhead_position", "Position", repeats),
    ]


def _overhead(name: str, key: str, repeats: int) -> Benchmark:
    ratios, alive = [], []
    ours, theirs = np.zeros(repeats), np.zeros(repeats)
    for i in range(repeats):
        builders: list[Callable[[], Simulator]] = [lambda: _station(key), lambda: _hardware_sim(key)]
        built = [builder() for builder in (builders if i % 2 else builders[::-1])]
        a, b = built if i % 2 else built[::-1]
        alive.append((a, b))
        for k in range(1, CHUNKS + 1):
            times = {}
            for simulator in (a, b) if k % 2 else (b, a):
                start = time.process_time()
                simulator.AdvanceTo(k * CHUNK)
                times[simulator is a] = time.process_time() - start
            ratios.append(times[True] / times[False])
            ours[i] += times[True]
            theirs[i] += times[False]
        if not np.array_equal(_state(a), _state(b)):
            raise RuntimeError("the station and hardware_sim have come to different states")
    return Benchmark(
        name=name,
        value=float(np.median(ratios)),
        unit="1",
        goal=1.05,
        better=LOWER,
        against="Drake's hardware_sim loop on the same file",
        note=f"{CHUNK * CHUNKS:g} s: station {spread(ours)}, hardware_sim {spread(theirs)}; equal states",
    )


def _station(key: str) -> Simulator:
    def make_dps(station: Station) -> Diagram:
        builder = DiagramBuilder()
        commands = {f"iiwa_{port}": values for port, values in _constants(key).items()}
        for name, values in {**commands, "wsg_position": [OPENING], "wsg_force_limit": [FORCE]}.items():
            source = builder.AddNamedSystem(name, ConstantVectorSource(values))
            builder.ExportOutput(source.get_output_port(), name)
        return builder.Build()

    testbed = Station(f"{FILE}#{key}", dps=make_dps).build()
    simulator = testbed.simulator()
    simulator.Initialize()
    return simulator


def _hardware_sim(key: str) -> Simulator:
    grip = lcmt_schunk_wsg_command()
    grip.utime, grip.target_position_mm, grip.force = 1, 1e3 * OPENING, FORCE
    sources = {port: ConstantVectorSource(values) for port, values in _constants(key).items()}
    urls = {"iiwa": "memq://null", "wsg": "memq://wsg"}
    simulator = hardware_sim_loop.build(FILE, key, urls=urls, grip=grip, sources=sources).simulator
    simulator.Initialize()
    return simulator


def _constants(key: str) -> dict[str, np.ndarray]:
    return {"torque": np.zeros(len(HOME))} if key == "Torque" else {"position": HOME}


def _state(simulator: Simulator) -> np.ndarray:
    plant = simulator.get_system().GetSubsystemByName("plant")
    return np.array(plant.GetPositionsAndVelocities(plant.GetMyContextFromRoot(simulator.get_context())))
