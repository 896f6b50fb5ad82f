"""The SpaceClimber in the world that it believes to be in: what it simulates after it has looked around."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Self

import numpy as np
from pydrake.geometry import Box
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

from vtbdrake.compiled import FixedPiece
from vtbdrake.components.world_model import (
    AttributeValue,
    Part,
    WorldModel,
    WorldObject,
    add_to_plant,
    position_estimate,
)
from vtbdrake.components.world_model.geometry import PARTS, PartsOf, placed_parts
from vtbdrake.testbed import ScenarioError, VirtualTestbedBuilder
from vtbdrake_diagrams.space_climber.believed_terrain import ground_parts
from vtbdrake_diagrams.space_climber.crater_scenario import CraterScenario
from vtbdrake_diagrams.space_climber.morphology import Morphology
from vtbdrake_diagrams.space_climber.terrain import GREY


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
        add_to_plant(plant, self.world, parts=self._parts)
        stance = Morphology().stance[:, :2]
        x, y = self.world.find("ground")[0].p_WoOo_W[:2]
        return RigidTransform([x, y, max(self.ground_height(x + dx, y + dy) for dx, dy in stance)])

    @property
    def _parts(self) -> Mapping[str, PartsOf]:
        return {**PARTS, "rock": _rock_parts, "ground": partial(ground_parts, feet=self.friction)}

    def pieces(self, world: WorldModel) -> list[FixedPiece]:
        """Return ground and rocks of a world as pieces of a terrain, on which compiled rollouts of this robot stand.

        Args:
            world: Patches of ground and rocks.
        """
        return [
            FixedPiece(part.shape, X_WS, self.friction if part.friction is None else part.friction)
            for _, part, X_WS in placed_parts(world, parts=self._parts)
        ]

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


def _rock_parts(rock: WorldObject) -> Sequence[Part]:
    """Return the box of a rock with the attributes ``length``, ``width`` and ``height`` (m) around its origin."""
    size = [rock.number(name, unit="m") for name in ("length", "width", "height")]
    return (Part("rock", Box(*size), RigidTransform(), tuple(GREY)),)


def level_world(*, around: float = 30.0) -> WorldModel:
    """Return a level world at the height 0: nine patches of ground, each of this side in m.

    A testbed of it can be compiled, and then stand on the pieces of any other world.
    """
    attributes = {"size": AttributeValue(around, "m")} | {f"corner_{k}": AttributeValue(0.0, "m") for k in range(4)}
    places = [(around * i, around * j) for i in (0, -1, 1) for j in (0, -1, 1)]
    return WorldModel(
        [
            WorldObject(f"ground-{k}", "ground", position_estimate([x, y, 0.0], deviation=0.0), attributes)
            for k, (x, y) in enumerate(places)
        ]
    )


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
