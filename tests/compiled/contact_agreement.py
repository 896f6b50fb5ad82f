"""The agreement of compiled contact with Drake's: after single steps, and in the outcomes of rollouts.

``python -m tests.compiled.contact_agreement [--steps N] [--rollouts N] [--worlds NAME ...]`` prints a line for each
world.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
from pydrake.systems.analysis import Simulator

from tests.compiled.contact_worlds import WORLDS, ContactWorld, Outcome
from vtbdrake.compiled import CompiledRollouts
from vtbdrake.state.systems import collect

SAMPLE_PERIOD = 0.02  # s
NOISE = 1e-9  # of positions and velocities at the begin


@dataclass(frozen=True)
class OutcomeShares:
    """Numbers of outcomes that are alike.

    Attributes:
        rollouts: The number of rollouts.
        repeatable: How many of them are alike in Drake with noise at the begin.
        alike: How many of the repeatable ones are alike in Drake and compiled.
        happened: In how many of the repeatable ones it happened.
    """

    rollouts: int
    repeatable: int
    alike: int
    happened: int


def step_errors(world: ContactWorld, count: int, *, seed: int = 0) -> np.ndarray:
    """Return the difference of the velocities after one step from random states, shape (count,).

    The root of the kinetic energy of the difference is divided by the root of the kinetic energy in Drake.
    """
    diagram, plant = world.diagram, world.plant
    root, random = diagram.CreateDefaultContext(), np.random.default_rng(seed)
    context, period = plant.GetMyMutableContextFromRoot(root), plant.time_step()
    rollouts = CompiledRollouts(diagram, collect(diagram), root, horizon=period, sample_period=period, check=False)
    begins, ends, masses = [], [], []
    for _ in range(count):
        world.randomize(plant, context, random)
        begins.append(rollouts.walker.read(root))
        ends.append(np.array(plant.EvalUniquePeriodicDiscreteUpdate(context).value()[plant.num_positions() :]))
        masses.append(plant.CalcMassMatrix(context))
    batch = rollouts.from_z(np.array(begins), 0.0)
    assert batch.valid.all(), {reason for reason in batch.reasons if reason}
    v, expected = batch.final[:, _state(rollouts)][:, plant.num_positions() :], np.array(ends)
    energies = [np.einsum("ki,kij,kj->k", each, masses, each) for each in (v - expected, expected)]
    return np.sqrt(energies[0] / energies[1])


def outcome_shares(world: ContactWorld, count: int, *, seed: int = 0) -> OutcomeShares:
    """Return how many outcomes of random rollouts are alike."""
    diagram, plant = world.diagram, world.plant
    root, random = diagram.CreateDefaultContext(), np.random.default_rng(seed)
    context = plant.GetMyMutableContextFromRoot(root)
    rollouts = CompiledRollouts(
        diagram,
        collect(diagram),
        root,
        horizon=world.horizon,
        sample_period=SAMPLE_PERIOD,
        outputs=["plant.state"],
        check=False,
    )
    begins, in_drake, repeated = [], [], []
    for _ in range(count):
        world.randomize(plant, context, random)
        begins.append(rollouts.walker.read(root))
        begin = np.array(plant.GetPositionsAndVelocities(context))
        in_drake.append(_in_drake(world, begin, rollouts.times))
        repeated.append(_in_drake(world, begin + NOISE * random.standard_normal(begin.size), rollouts.times))
    batch = rollouts.from_z(np.array(begins), 0.0)
    own = plant.CreateDefaultContext()
    compiled = [world.outcome(plant, own, states) for states in batch.outputs["plant.state"]]
    kept = [k for k in range(count) if in_drake[k].is_like(repeated[k])]
    alike = sum(bool(batch.valid[k]) and compiled[k].is_like(in_drake[k]) for k in kept)
    return OutcomeShares(count, len(kept), alike, sum(in_drake[k].happened for k in kept))


def _in_drake(world: ContactWorld, begin: np.ndarray, times: np.ndarray) -> Outcome:
    simulator, plant = Simulator(world.diagram), world.plant
    own = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    plant.SetPositionsAndVelocities(own, begin)
    states_until = np.inf
    states = [begin]  # An advance to the begin would make the first update.
    for time in times[1:]:
        if simulator.get_context().get_time() >= states_until:
            states.append(states[-1])
            continue
        status = simulator.AdvanceTo(time)
        if not status.succeeded():  # A system has ended the simulation.
            states_until = simulator.get_context().get_time()
        states.append(np.array(plant.GetPositionsAndVelocities(own)))  # a view of the context
    return world.outcome(plant, plant.CreateDefaultContext(), np.array(states))


def _state(rollouts: CompiledRollouts) -> slice:
    blocks = rollouts.walker.vector.blocks.values()
    return next(b.entries for b in blocks if (b.path, b.kind) == ("plant", "discrete"))


def main() -> None:
    """Print how steps and outcomes agree."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1700, help="random states per world and approximation")
    parser.add_argument("--worlds", nargs="*", default=list(WORLDS), choices=list(WORLDS), help="which worlds")
    parser.add_argument("--rollouts", type=int, default=100, help="random rollouts per world and approximation")
    arguments = parser.parse_args()
    for name in arguments.worlds:
        make = WORLDS[name]
        # The climber reasons by SAP.
        for approximation in ("sap",) if name == "crater" else ("sap", "lagged"):
            errors = step_errors(make(approximation), arguments.steps)
            shares = outcome_shares(make(approximation), arguments.rollouts)
            print(
                f"{name}, {approximation}: {errors.size} steps, error {errors.max():.2g} at most, "
                f"{np.median(errors):.2g} in the median; {shares.alike} of {shares.repeatable} repeatable outcomes "
                f"alike ({shares.rollouts} rollouts, it happened in {shares.happened})",
                flush=True,
            )


if __name__ == "__main__":
    main()
