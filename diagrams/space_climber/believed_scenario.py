"""The SpaceClimber in the world that it believes to be in: what it simulates after it has looked around."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Self

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

from vtbdrake.components.world_model import WorldModel, add_to_plant
from vtbdrake.components.world_model.geometry import PARTS
from vtbdrake.testbed import ScenarioError, VirtualTestbedBuilder
from vtbdrake_diagrams.space_climber.believed_terrain import ground_parts
from vtbdrake_diagrams.space_climber.crater_scenario import CraterScenario
from vtbdrake_diagrams.space_climber.morphology import Morphology


@dataclass
class BelievedCraterScenario(CraterScenario):
    """The mental copy of a `CraterScenario`, whose ground and rocks are the objects of a semantic world model.

    It is made by `believed_world` of the running scenario, and is its own mental copy.
    """

    # Patches of ground and rocks, as `BelievedTerrain.world_model` returns them.
    world: WorldModel = field(default_factory=WorldModel)

    def validate(self) -> None:
        super().validate()
        if not self.world.find("ground"):
            raise ScenarioError(
                f"BelievedCraterScenario.world has no patch of ground, only {self.world!r}: make it by "
                "BelievedTerrain.world_model, around the robot"
            )

    def mental(self) -> Self:
        return self

    def _add_ground(self, plant: MultibodyPlant) -> RigidTransform:
        add_to_plant(plant, self.world, parts={**PARTS, "ground": partial(ground_parts, feet=self.friction)})
        stance = Morphology().stance[:, :2]
        x, y = self.world.find("ground")[0].p_WoOo_W[:2]
        return RigidTransform([x, y, max(self.ground_height(x + dx, y + dy) for dx, dy in stance)])

    def ground_height(self, x: float, y: float) -> float:
        """Return the believed height of the ground in m; beside all patches, of the nearest one's middle."""
        patches = self.world.find("ground")
        offsets = np.array([patch.p_WoOo_W[:2] for patch in patches]) - [x, y]
        patch = patches[int(np.argmin(np.hypot(*offsets.T)))]
        u, v = np.clip(([x, y] - patch.p_WoOo_W[:2]) / patch.number("size", unit="m") + 0.5, 0.0, 1.0)
        southwest, southeast, northeast, northwest = (patch.number(f"corner_{k}", unit="m") for k in range(4))
        # The two triangles of `ground_parts` meet along the diagonal u = v.
        if u >= v:
            rise = southwest + u * (southeast - southwest) + v * (northeast - southeast)
        else:
            rise = southwest + u * (northeast - northwest) + v * (northwest - southwest)
        return float(patch.p_WoOo_W[2] + rise)

    def _declare_belief(self, builder: VirtualTestbedBuilder) -> None:
        place = ["dps.impl.navigator.position", "dps.env.position[2]"]
        self._believe_base(builder, place, lambda p, height: [*p, height + self.ground_height(*p)])
        self._believe_joints(builder)


def believed_world(scenario: CraterScenario, world: WorldModel, *, friction: float) -> BelievedCraterScenario:
    """Return what the robot of a scenario simulates in the world that it believes to be in.

    Args:
        scenario: The robot's scenario; of its crater nothing is used.
        world: Patches of ground and rocks around the robot.
        friction: The friction where none was felt.
    """
    mental = CraterScenario.mental(scenario)
    return BelievedCraterScenario(
        simulator_config=mental.simulator_config,
        plant_config=mental.plant_config,
        gravity=scenario.gravity,
        friction=friction,
        gait=scenario.gait,
        period=scenario.period,
        joint_stops=scenario.joint_stops,
        clearance=scenario.clearance,
        patience=scenario.patience,
        world=world,
    )
