"""Another terrain under a compiled plant, without another compilation."""

from __future__ import annotations

import gc
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import Box, Convex, ProximityProperties, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder

from tests.compiled.quadruped import surface
from vtbdrake.compiled import CompiledRollouts, FixedPiece, UnsupportedTestbedError
from vtbdrake.components.compiled_plant import PlantDynamics
from vtbdrake.components.compiled_plant.contact import PointContact, contact_pairs
from vtbdrake.state.systems import collect

RADIUS = 0.1
BALL = surface(0.5)
HORIZON = 0.4
STATE = "plant.state"


def pieces(seed: int, friction: float) -> list[FixedPiece]:
    """Return 25 boxes and prisms, 0.4 m apart, with tilted tops of different heights."""
    rng, made = np.random.default_rng(seed), []
    for k in range(25):
        place = [0.4 * (k % 5 - 2), 0.4 * (k // 5 - 2), rng.uniform(-0.55, -0.45)]
        X_WP = RigidTransform(RollPitchYaw(rng.uniform(-0.2, 0.2, 3)), place)
        corners = 0.25 * np.array([[x, y, 2.0 * z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
        shape = Box(0.5, 0.5, 1.0) if k % 2 else Convex(points=corners.T, label="piece")
        made.append(FixedPiece(shape, X_WP, friction))
    return made


def ball_on(terrain: list[FixedPiece]) -> Diagram:
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(
        time_step=0.005,
        contact_model="point",
        discrete_contact_approximation="sap",
        use_sampled_output_ports=False,
    )
    plant, _ = AddMultibodyPlant(config, builder)
    ball = plant.AddRigidBody("ball", SpatialInertia.SolidSphereWithMass(1.0, RADIUS))
    plant.RegisterCollisionGeometry(ball, RigidTransform(), Sphere(RADIUS), "ball", BALL)
    for k, piece in enumerate(terrain):
        material: ProximityProperties = surface(piece.friction)
        plant.RegisterCollisionGeometry(plant.world_body(), piece.X_WP, piece.shape, f"piece_{k}", material)
    plant.Finalize()
    plant.SetDefaultFloatingBaseBodyPose(ball, RigidTransform([0.07, 0.05, 0.2]))
    return builder.Build()


def compiled(diagram: Diagram) -> CompiledRollouts:
    context = diagram.CreateDefaultContext()
    return CompiledRollouts(
        diagram, collect(diagram), context, horizon=HORIZON, sample_period=0.1, outputs=[STATE], check=False
    )


def drakes(diagram: Diagram) -> np.ndarray:
    simulator = Simulator(diagram)
    simulator.AdvanceTo(HORIZON)
    plant = diagram.GetSubsystemByName("plant")
    state: np.ndarray = plant.GetOutputPort("state").Eval(plant.GetMyContextFromRoot(simulator.get_context()))
    return state


@pytest.fixture(scope="module")
def rollouts() -> CompiledRollouts:
    return compiled(ball_on(pieces(0, 0.5)))


@pytest.mark.parametrize(("seed", "friction"), [(1, 0.5), (2, 0.1)])
def test_rollouts_on_another_terrain_are_drakes(rollouts: CompiledRollouts, seed: int, friction: float) -> None:
    here = rollouts().outputs[STATE][0, -1]
    rollouts.stand_on(rollouts.terrain(pieces(seed, friction)))
    there = rollouts()
    rollouts.stand_on(None)
    assert there.valid.all()
    expected = drakes(ball_on(pieces(seed, friction)))
    np.testing.assert_allclose(there.outputs[STATE][0, -1], expected, atol=1e-4)
    assert np.abs(here - expected).max() > 1e-2
    np.testing.assert_array_equal(rollouts().outputs[STATE][0, -1], here)


def test_a_ground_is_compiled_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Drake counts geometries over all Diagrams of a process: their numbers are no part of the machine code."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for _ in range(2):
        diagram = ball_on(pieces(4, 0.5))
        plant = diagram.GetSubsystemByName("plant")
        context = plant.GetMyContextFromRoot(diagram.CreateDefaultContext())
        model = PlantDynamics(plant, plant.CreateDefaultContext())
        PointContact(plant, model, contact_pairs(plant, context))
    assert len(list(tmp_path.rglob("ground_*.so"))) == 1


def test_numbers_of_terrains_are_used_again(rollouts: CompiledRollouts) -> None:
    first = rollouts.terrain(pieces(1, 0.5))
    second = rollouts.terrain(pieces(2, 0.5))
    number = first.number
    assert number != second.number
    del first
    gc.collect()
    assert rollouts.terrain(pieces(3, 0.5)).number == number


def test_a_terrain_that_is_gone_is_no_ground(rollouts: CompiledRollouts) -> None:
    """Its number in a vector of states is a doubt, not a fall through nothing."""
    kernel = rollouts.walker.equations["plant"]
    kernel.constants["terrain"] = 1000.0
    batch = rollouts()
    kernel.constants["terrain"] = 0.0
    assert not batch.valid.any()


def test_impossible_terrains_are_refused(rollouts: CompiledRollouts) -> None:
    with pytest.raises(ValueError, match="at least one piece"):
        rollouts.terrain([])
    with pytest.raises(ValueError, match="a Box or a Convex, not a Sphere"):
        rollouts.terrain([FixedPiece(Sphere(1.0), RigidTransform(), 0.5)])
    few = compiled(ball_on(pieces(0, 0.5)[:4]))
    with pytest.raises(UnsupportedTestbedError, match="more than sixteen fixed pieces"):
        few.terrain(pieces(1, 0.5))
