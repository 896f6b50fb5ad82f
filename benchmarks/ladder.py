"""Measure where the time of a rollout goes: the same world, from plain Drake up to a rollout of the testbed.

Processor time, of variants that run in turns. What a rung takes beyond the one above is the price of what it adds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlant
from pydrake.systems.analysis import Simulator, SimulatorConfig
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, TrajectorySource, ZeroOrderHold
from pydrake.trajectories import PiecewisePolynomial

from benchmarks.cpp_climber import JOINTS, CppClimberScenario
from benchmarks.measure import LOWER, Benchmark, processor_time
from benchmarks.plain_climber import build_plain_climber
from vtbdrake.components.sensors import ErrorModel
from vtbdrake.rollout import RolloutRunner, RolloutTask
from vtbdrake.testbed.integrator import apply_simulator_config
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.cart_pole.model import CART_POLE_SDF
from vtbdrake_diagrams.cart_pole.swing_up import make_reasoner
from vtbdrake_diagrams.satellite import SatelliteScenario
from vtbdrake_diagrams.satellite.dps import PERIOD
from vtbdrake_diagrams.satellite.plant import add_servicer, add_target
from vtbdrake_diagrams.satellite.start import Release, random_start
from vtbdrake_diagrams.space_climber import SpaceClimberScenario
from vtbdrake_diagrams.space_climber.studies.payload import payload_problem

# Prepares what is measured: a function that simulates.
Rung = Callable[[], Callable[[], object]]

IN_A_ROW = 4
# Simulated seconds.
SWING, WALK, CAPTURE = 1.0, 5.0, 20.0
# The position of the servicer's joints that its DPS commands.
COMMANDED = "dps.joint_position"


def rollout_ladder(repeats: int = 40) -> Benchmark:
    """Processor time of a rollout of the cart-pole's mental copy over its plant's in plain Drake."""
    return _ladder("rollout_ladder", _cart_pole(), seconds=SWING, repeats=repeats, goal=None)


def rollout_ladder_climber(repeats: int = 20) -> Benchmark:
    """Processor time of a rollout of the climber over its robot's in plain Drake, with a recorded gait."""
    return _ladder("rollout_ladder_climber", _climber(), seconds=WALK, repeats=repeats, goal=1.45)


def capture_ladder(repeats: int = 2) -> Benchmark:
    """Processor time of a rollout of the satellite, with its pose sensor, over its plant's alone in plain Drake.

    The plant makes the same motion, in as many steps: its servos follow what the DPS commands in the testbed, sample by
    sample. What the testbed adds is its sensors and its DPS, eight systems in Python at 50 Hz, as they run aboard.
    """
    row = _ladder("capture_ladder", _capture(), seconds=CAPTURE, repeats=repeats, goal=1.6)
    return replace(
        row,
        note=f"{row.note}; the testbed adds sensors and DPS, eight systems in Python at {1.0 / PERIOD:g} Hz; 20 times "
        "real time, a former goal, are 50 ms for a simulated second",
    )


def _cart_pole() -> dict[str, Rung]:
    """Return the rungs up to what `predictive_sampling_testbed` simulates."""
    with make_reasoner(CartPoleScenario(), executor="serial") as reasoner:
        task = reasoner.task
    mental = CartPoleScenario().mental()
    # A latency that can be set later needs our own sensors.
    errors = ErrorModel(max_latency=1)
    python = replace(task, scenario=replace(mental, position_errors=errors, velocity_errors=errors))
    simulation = partial(_simulation, config=mental.simulator_config, seconds=SWING)
    return {
        "the plant in plain Drake": simulation(_plain_cart_pole(mental, holds=0)),
        "with four holds": simulation(_plain_cart_pole(mental, holds=4)),
        "the testbed": simulation(mental.build().diagram),
        "a rollout with 2 samples of f": _rollout(replace(task, sample_period=SWING)),
        "with 26 samples": _rollout(task),
        "with sensors in Python, whose latency can be set": _rollout(python),
    }


def _plain_cart_pole(scenario: CartPoleScenario, *, holds: int) -> Diagram:
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(scenario.plant_config, builder)
    Parser(plant).AddModels(str(CART_POLE_SDF))
    plant.Finalize()
    force = builder.AddSystem(ConstantVectorSource([0.0]))
    builder.Connect(force.get_output_port(), plant.get_actuation_input_port())
    for _ in range(holds):
        hold = builder.AddSystem(ZeroOrderHold(scenario.period, plant.num_multibody_states()))
        builder.Connect(plant.get_state_output_port(), hold.get_input_port())
    return builder.Build()


class _HeldGait(CppClimberScenario):
    """The gait changes at the sample times, as the command of the DPS does, which end the steps of the integrator."""

    def make_dps(self) -> Diagram:
        builder = DiagramBuilder()
        gait = builder.AddNamedSystem("gait", super().make_dps())
        hold = builder.AddNamedSystem("hold", ZeroOrderHold(self.period, JOINTS))
        builder.Connect(gait.get_output_port(), hold.get_input_port())
        builder.ExportOutput(hold.get_output_port(), "joint_position")
        return builder.Build()


def _climber() -> dict[str, Rung]:
    """Return the rungs up to what `rollout_rtf` simulates."""
    scenario = SpaceClimberScenario()
    task = replace(payload_problem(phases=(0.0,)).task, scenario=scenario, horizon=WALK)
    simulation = partial(_simulation, config=scenario.simulator_config, seconds=WALK)
    return {
        "plain Drake with a recorded gait": simulation(_HeldGait().build().diagram),
        "sensors and DPS, wired by hand": simulation(build_plain_climber(scenario).diagram),
        "the testbed": simulation(scenario.build().diagram),
        "a rollout with 2 samples of f": _rollout(replace(task, sample_period=WALK)),
        "with 51 samples": _rollout(task),
    }


def _capture() -> dict[str, Rung]:
    """Return the rungs up to a rollout with the pose sensor."""
    scenario = SatelliteScenario(perception="pose_sensor")
    task = RolloutTask(scenario, CAPTURE, sample_period=0.1, record=(COMMANDED,))
    simulation = partial(_simulation, config=scenario.simulator_config, seconds=CAPTURE)
    return {
        "the plant in plain Drake": simulation(_plain_satellite(scenario)),
        "the testbed": simulation(scenario.build().diagram),
        "a rollout with 2 samples": _rollout(replace(task, sample_period=CAPTURE)),
        "with 201 samples": _rollout(task),
    }


def _plain_satellite(scenario: SatelliteScenario) -> Diagram:
    """Return servicer and target, which tumbles, with servos that follow the commands of the testbed's DPS."""
    recorded = RolloutTask(scenario, CAPTURE, sample_period=PERIOD, record=(COMMANDED,))
    result = RolloutRunner(recorded).run({})
    start = random_start(scenario.seed, tumble=np.radians(scenario.tumble_deg), distance=scenario.distance)
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(scenario.plant_config, builder)
    servicer = add_servicer(plant)
    target = add_target(plant, start.X_WT)
    plant.Finalize()
    commands = np.asarray(result.record[COMMANDED]).T
    servos = np.vstack([commands, np.zeros_like(commands)])
    source = builder.AddSystem(TrajectorySource(PiecewisePolynomial.ZeroOrderHold(result.times, servos)))
    hold = builder.AddSystem(ZeroOrderHold(PERIOD, len(servos)))
    release = builder.AddSystem(Release(plant, target, start))
    builder.Connect(source.get_output_port(), hold.get_input_port())
    builder.Connect(hold.get_output_port(), plant.get_desired_state_input_port(servicer))
    builder.Connect(plant.get_state_output_port(), release.get_input_port())
    builder.Connect(release.get_output_port(), plant.get_applied_spatial_force_input_port())
    return builder.Build()


def _simulation(diagram: Diagram, config: SimulatorConfig, seconds: float) -> Rung:
    def prepare() -> Callable[[], object]:
        simulator = Simulator(diagram)
        apply_simulator_config(config, simulator)
        # It initializes at first.
        return partial(simulator.AdvanceTo, seconds)

    return prepare


def _rollout(task: RolloutTask) -> Rung:
    runner = RolloutRunner(task)
    return lambda: partial(runner.run, {})


def _ladder(name: str, rungs: dict[str, Rung], *, seconds: float, repeats: int, goal: float | None) -> Benchmark:
    """Return the time of the rung that takes longest over the first one's."""
    times: dict[str, list[float]] = {rung: [] for rung in rungs}
    for _ in range(repeats):
        for rung, prepare in rungs.items():
            # Some in a row, as in a decision: the first one finds the processor's caches full of other things.
            times[rung] += [processor_time(prepare()) for _ in range(IN_A_ROW)]
    # What else the machine does only adds to them.
    least = {rung: 1e3 * min(taken) / seconds for rung, taken in times.items()}
    return Benchmark(
        name=name,
        value=max(least.values()) / next(iter(least.values())),
        unit="1",
        goal=goal,
        better=LOWER,
        against=f"{next(iter(rungs))}, in processor time",
        note="for a simulated second, "
        + "; ".join(f"{rung}: {value:.3g} ms" for rung, value in least.items())
        + f"; n = {IN_A_ROW * repeats}",
    )
