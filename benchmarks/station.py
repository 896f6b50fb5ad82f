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
    are built in rotating order, as `testbed_overhead` is measured. The arm's driver has no LCM bus in either; the
    gripper's has one in Drake, which adds its messages to the arithmetic.

    The floor is Drake's loop with as many port switches as the station has, wired by hand: what it costs to choose
    signal by signal, whoever does it.
    """
    return [
        *_overhead("station_overhead", "Torque", repeats),
        *_overhead("station_overhead_position", "Position", repeats),
    ]


def _overhead(name: str, key: str, repeats: int) -> list[Benchmark]:
    builders: list[Callable[[], Simulator]] = [
        lambda: _station(key),
        lambda: _hardware_sim(key),
        lambda: _hardware_sim(key, switched=True),
    ]
    alive = []
    times = np.zeros((repeats, CHUNKS, len(builders)))
    for i in range(repeats):
        order = np.roll(range(len(builders)), i)
        built = {j: builders[j]() for j in order}
        alive.append(built)
        for k in range(CHUNKS):
            for j in np.roll(order, k):
                start = time.process_time()
                built[j].AdvanceTo((k + 1) * CHUNK)
                times[i, k, j] = time.process_time() - start
        if not all(np.array_equal(_state(built[0]), _state(other)) for other in built.values()):
            raise RuntimeError("the station and hardware_sim have come to different states")
    station, drake, switched = times.sum(axis=1).T
    note = f"{CHUNK * CHUNKS:g} s: station {spread(station)}, hardware_sim {spread(drake)}; equal states"
    floor_note = f"{CHUNK * CHUNKS:g} s: {spread(switched)}; the same states"
    rows = [(name, times[..., 0], 1.05, note), (f"{name}_floor", times[..., 2], None, floor_note)]
    return [
        Benchmark(
            name=row,
            value=float(np.median(taken / times[..., 1])),
            unit="1",
            goal=goal,
            better=LOWER,
            against="Drake's hardware_sim loop on the same file",
            note=note,
        )
        for row, taken, goal, note in rows
    ]


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


def _hardware_sim(key: str, *, switched: bool = False) -> Simulator:
    grip = lcmt_schunk_wsg_command()
    grip.utime, grip.target_position_mm, grip.force = 1, 1e3 * OPENING, FORCE
    sources = {port: ConstantVectorSource(values) for port, values in _constants(key).items()}
    urls = {"iiwa": "memq://null", "wsg": "memq://wsg"}
    simulator = hardware_sim_loop.build(FILE, key, urls=urls, grip=grip, sources=sources, switched=switched).simulator
    simulator.Initialize()
    return simulator


def _constants(key: str) -> dict[str, np.ndarray]:
    return {"torque": np.zeros(len(HOME))} if key == "Torque" else {"position": HOME}


def _state(simulator: Simulator) -> np.ndarray:
    plant = simulator.get_system().GetSubsystemByName("plant")
    return np.array(plant.GetPositionsAndVelocities(plant.GetMyContextFromRoot(simulator.get_context())))
