"""Methods of a reasoner on the same decisions, with their default options: ``python -m benchmarks.decision_methods``.

Prints the table of docs/reasoning.md. A seed determines the state in which a decision is made, and the random numbers
of the method. All methods have the same number of rollouts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import click
import numpy as np

from tests.reasoning.scenarios import MassScenario
from vtbdrake.cli.output import table
from vtbdrake.optimization import Parameter
from vtbdrake.reasoning import Belief, Budget, Reasoner, SearchConfig
from vtbdrake.rollout import Constraint, Quality
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.cart_pole.decision import reasoning
from vtbdrake_diagrams.cart_pole.swing_up import make_reasoner, swing_up
from vtbdrake_diagrams.manipulator.scenario import ManipulatorScenario
from vtbdrake_diagrams.manipulator.studies.pick_up import LARGEST_ERROR, Load

METHODS = ("CEM", "predictive-sampling", "MPPI", "CMA-ES", "random")
# A cost is close to the best of all methods if it is larger by at most this share of what random candidates reach.
CLOSE = 0.05

# The costs that a method reaches with the given number of rollouts per decision, one per seed.
Costs = Callable[[str, int, range], list[float]]


@dataclass(frozen=True)
class Decisions:
    """Decisions of one kind, one per seed.

    Attributes:
        name: What is decided.
        costs: Function that makes them.
        budgets: Numbers of rollouts per decision.
        seeds: The seeds.
    """

    name: str
    costs: Costs
    budgets: tuple[int, ...]
    seeds: range = range(20)


def bang_bang(method: str, rollouts: int, seeds: range) -> list[float]:
    """Return how far from its goal a mass comes to rest, in m, if it is pushed, and pulled after a decided time."""
    scenario, costs = MassScenario(), []
    testbed = scenario.build()
    for seed in seeds:
        goal = np.random.default_rng(seed).uniform(0.2, 2.0)

        def distance(state: np.ndarray, goal: float = goal) -> float:
            return float(abs(state[0] - goal) + abs(state[1]))

        with Reasoner(
            scenario=scenario,
            decision=[Parameter("u.switch", 0.0, 3.0)],
            quality=Quality(distance, of="sim.sys.mass.y0", minimize=True, reading="end"),
            horizon=3.0,
            sample_period=1.0,
            budget=Budget(rollouts=rollouts),
            search=SearchConfig(method=method, executor="serial"),
            seed=seed,
        ) as reasoner:
            costs.append(reasoner.decide(Belief.perfect(testbed, testbed.default_context())).quality)
    return costs


def one_plan(method: str, rollouts: int, seeds: range) -> list[float]:
    """Return the costs of plans for a cart-pole that moves in some way."""
    scenario = CartPoleScenario()
    testbed, costs = scenario.build(), []
    search = SearchConfig(method=method, executor="serial")
    with make_reasoner(scenario, rollouts=rollouts, search=search) as reasoner:
        for seed in seeds:
            context = testbed.default_context()
            # The time determines the method's random numbers.
            context.SetTime(seed)
            for name, deviation in {"cart_slider": (0.2, 0.5), "pole_pin": (1.5, 3.0)}.items():
                values = np.random.default_rng([seed, len(name)]).normal(size=2) * deviation
                for kind, value in zip(("position", "velocity"), values.tolist(), strict=True):
                    testbed.write(context, {f"sim.sys.cart_pole.{name}.{kind}": value})
            costs.append(reasoner.decide(Belief.perfect(testbed, context)).quality)
    return costs


def swing_ups(method: str, rollouts: int, seeds: range) -> list[float]:
    """Return the mean costs of swing-ups of 6 s, in which a plan is decided every 0.1 s."""
    scenario, costs = CartPoleScenario(), []
    cost = reasoning(scenario, "u.plan", Budget(rollouts=1))["quality"].f
    search = SearchConfig(method=method, executor="compiled")
    for seed in seeds:
        with make_reasoner(scenario, rollouts=rollouts, search=search, seed=seed) as reasoner:
            costs.append(float(np.mean([cost(state) for state in swing_up(reasoner, scenario).states])))
    return costs


def soft_arm(method: str, rollouts: int, seeds: range) -> list[float]:
    """Return the mean stiffness, over the default's, with which an arm keeps to its reference under a load."""
    scenario = ManipulatorScenario(law="joint_impedance", knows_tool=True)
    testbed, costs = scenario.build(), []
    context = testbed.default_context()
    default = np.array(testbed.read(context, "dps.impl.stiffness"))
    joints = range(4)  # those that carry the load
    reference, position = "dps.impl.reference", "dps.env.joint_position"

    def softness(stiffness: Any) -> Any:
        return sum(stiffness[k] / default[k] for k in joints) / len(joints)

    with Reasoner(
        scenario=scenario,
        decision=[Parameter(f"dps.impl.stiffness[{k}]", 0.25 * default[k], 4.0 * default[k]) for k in joints],
        quality=Quality(softness, of="dps.impl.stiffness", reading="end", minimize=True),
        constraints=[
            Constraint(_deviation(k), of=[reference, position], at_most=LARGEST_ERROR, reading="end") for k in joints
        ],
        horizon=1.0,
        sample_period=0.1,
        budget=Budget(rollouts=rollouts),
        search=SearchConfig(method=method, executor="compiled"),
    ) as reasoner:
        for seed in seeds:
            context.SetTime(seed)
            load = Load(float(np.random.default_rng(seed).uniform(0.1, 1.0))).values()
            mass, center = load.values()
            testbed.write(context, {"dps.tool.mass": mass, "dps.tool.center": center})
            decision = reasoner.decide(testbed, context)
            costs.append(decision.quality if decision else float("inf"))
    return costs


def _number(cost: float) -> str:
    # Without an eligible candidate, a decision has no quality.
    return f"{cost:.3g}" if np.isfinite(cost) else "none"


def _deviation(joint: int) -> Callable[[Any, Any], Any]:
    return lambda reference, position: abs(reference[joint] - position[joint])


DECISIONS = (
    Decisions("a mass is pushed, then pulled: when?", bang_bang, (30, 60)),
    Decisions("cart-pole, one plan, 10 knots", one_plan, (32, 100)),
    Decisions("cart-pole, swing-up, a plan every 0.1 s", swing_ups, (32,)),
    Decisions("arm, 4 stiffnesses under 4 constraints", soft_arm, (30, 60)),
)


@click.command()
@click.argument("only", nargs=-1)
def main(only: tuple[str, ...]) -> None:
    """Print the median costs of the decisions ONLY, or of all, and the share of seeds with a cost close to the best."""
    rows = []
    for decisions in DECISIONS:
        if only and decisions.costs.__name__ not in only:
            continue
        for rollouts in decisions.budgets:
            click.echo(f"{decisions.name}, {rollouts} rollouts", err=True)
            costs = np.array([decisions.costs(method, rollouts, decisions.seeds) for method in METHODS])
            best, scale = costs.min(axis=0), np.median(costs[-1])
            close = (np.isfinite(costs) & (costs <= best + CLOSE * scale)).mean(axis=1)
            cells = [f"{_number(np.median(c))} ({share:.0%})" for c, share in zip(costs, close, strict=True)]
            rows.append([decisions.name, str(rollouts), *cells])
    click.echo(table(["decision", "rollouts", *METHODS], rows))


if __name__ == "__main__":
    main()
