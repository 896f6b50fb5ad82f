"""What was written is what is there, in any order, and what is copied comes back to the last bit."""

import itertools

import numpy as np
import pytest
from pydrake.geometry import (
    Box,
    ClippingRange,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    RenderCameraCore,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo, RgbdSensor

from vtbdrake.state import VariableError, collect
from vtbdrake.state.snapshot import StateCopier

FRICTIONS = [(0.3, 0.2), (0.9, 0.8), (0.9, 0.8)]


def _world():
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
    plant.set_name("plant")
    body = plant.AddRigidBody("box", plant.AddModelInstance("box"), SpatialInertia.SolidBoxWithMass(2.0, 0.3, 0.4, 0.1))
    for i, (static, dynamic) in enumerate(FRICTIONS):
        X_BG = RigidTransform([0.1 * i, 0.0, 0.0])
        plant.RegisterCollisionGeometry(body, X_BG, Sphere(0.01), f"foot{i}", CoulombFriction(static, dynamic))
    plant.RegisterCollisionGeometry(
        plant.world_body(), RigidTransform([0, 0, -1]), Box(9, 9, 1), "ground", CoulombFriction(0.8, 0.8)
    )
    plant.Finalize()
    core = RenderCameraCore("none", CameraInfo(64, 48, 1.0), ClippingRange(0.01, 10.0), RigidTransform())
    pose = RigidTransform(RollPitchYaw(0.1, 0.2, 0.3), [0.0, 0.0, 1.0])
    depth = DepthRenderCamera(core, DepthRange(0.1, 5.0))
    builder.AddNamedSystem("camera", RgbdSensor(scene_graph.world_frame_id(), pose, ColorRenderCamera(core), depth))
    diagram = builder.Build()
    return diagram, collect(diagram)


INERTIA = [0.2, 0.3, 0.4, 0.01, 0.02, 0.03]


@pytest.mark.parametrize("order", list(itertools.permutations(["mass", "inertia", "center_of_mass"])))
def test_the_order_of_values_does_not_matter(order):
    diagram, variables = _world()
    context = diagram.CreateDefaultContext()
    values = {"mass": 4.0, "inertia": INERTIA, "center_of_mass": [0.1, 0.2, 0.3]}
    variables.write(context, {f"plant.box.{name}": values[name] for name in order})
    for name, value in values.items():
        np.testing.assert_allclose(variables[f"plant.box.{name}"].get(context), value, atol=1e-12)


def test_entries_of_a_pose_are_set_together():
    diagram, variables = _world()
    context = diagram.CreateDefaultContext()
    variables.write(context, {"camera.pose[5]": 0.1, "camera.pose[4]": 2.0, "camera.pose[3]": 0.0})
    expected = RollPitchYaw(0.0, 2.0, 0.1).ToRotationMatrix().matrix()
    np.testing.assert_allclose(variables["camera.pose_matrix"].get(context)[:, :3], expected, atol=1e-12)


def test_an_array_is_given_whole_or_by_entries():
    diagram, variables = _world()
    with pytest.raises(VariableError, match="both whole and by its entry"):
        variables.write(diagram.CreateDefaultContext(), {"camera.pose": [0, 0, 0, 0, 0, 0], "camera.pose[4]": 2.0})


def test_a_copy_restores_each_geometrys_friction_and_the_cameras_pose_exactly():
    diagram, variables = _world()
    default, context = diagram.CreateDefaultContext(), diagram.CreateDefaultContext()
    np.testing.assert_array_equal(variables["plant.box.friction_by_geometry"].get(default), FRICTIONS)
    variables.write(context, {"plant.box.friction": 0.1, "camera.pose": [1, 2, 3, 0.4, 0.5, 0.6]})
    np.testing.assert_array_equal(variables["plant.box.friction_by_geometry"].get(context), np.full((3, 2), 0.1))
    StateCopier(diagram, variables, diagram, variables).copy(default, context)
    np.testing.assert_array_equal(variables["plant.box.friction_by_geometry"].get(context), FRICTIONS)
    for address in ("camera.pose", "camera.pose_matrix"):
        np.testing.assert_array_equal(variables[address].get(context), variables[address].get(default))
    with pytest.raises(VariableError, match="the dynamic one not larger"):
        variables["plant.box.friction_by_geometry"].set(context, [[0.1, 0.2]] * 3)
