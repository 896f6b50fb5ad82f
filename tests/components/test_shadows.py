"""Shadows against rays that are intersected with the geometry."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.geometry import (
    Box,
    GeometryInstance,
    MakeRenderEngineVtk,
    PerceptionProperties,
    QueryObject,
    RenderEngineVtkParams,
    SceneGraph,
)
from pydrake.math import RigidTransform

from vtbdrake.components.rendering import check_rendering
from vtbdrake.components.shadows import sunlit

# Centre and size: a thick wall, a plate before it, a box in front of both that is as deep as it is wide.
BOXES = [((0.0, 0.0, -0.2), (2.0, 2.0, 0.4)), ((0.3, 0.2, 0.5), (0.4, 0.4, 0.01)), ((-0.4, -0.3, 0.9), (0.5, 0.5, 0.5))]


# m, between the points of the wall.
SPACING = 1.94 / 149


@pytest.fixture(scope="module")
def scene() -> tuple[SceneGraph, QueryObject]:
    check_rendering()
    scene_graph = SceneGraph()
    source = scene_graph.RegisterSource("boxes")
    for k, (center, size) in enumerate(BOXES):
        box = GeometryInstance(RigidTransform(center), Box(*size), f"{k}")
        box.set_perception_properties(PerceptionProperties())
        scene_graph.RegisterAnchoredGeometry(source, box)
    scene_graph.AddRenderer("sun", MakeRenderEngineVtk(RenderEngineVtkParams(backend="EGL")))
    context = scene_graph.CreateDefaultContext()
    return scene_graph, scene_graph.get_query_output_port().Eval(context)


def meets_box(points: np.ndarray, way: np.ndarray, center: tuple, size: tuple, margin: float) -> np.ndarray:
    """Whether each ray from a point along ``way`` meets the box, grown by ``margin``, farther than 1 mm away."""
    half = np.array(size) / 2.0 + margin
    with np.errstate(divide="ignore"):
        first, second = (-half - (points - center)) / way, (half - (points - center)) / way
    enters, leaves = np.minimum(first, second).max(axis=1), np.maximum(first, second).min(axis=1)
    return (enters < leaves) & (enters > 1e-3)


@pytest.mark.parametrize("angle_deg", [0.0, 5.0, 20.0, 45.0, 70.0, 86.0])
def test_shadows_are_those_of_the_geometry(scene: tuple, angle_deg: float) -> None:
    angle = np.radians(angle_deg)
    direction = np.array([np.sin(angle), 0.3 * np.sin(angle), -np.cos(angle)])
    direction /= np.linalg.norm(direction)
    grid = np.stack(np.meshgrid(np.linspace(-0.97, 0.97, 150), np.linspace(-0.97, 0.97, 150)), axis=-1).reshape(-1, 2)
    wall = np.column_stack((grid, np.zeros(len(grid))))
    # Beside the wall, the lit top of the box.
    top = np.column_stack((0.24 * grid[:, 0] - 0.4, 0.24 * grid[:, 1] - 0.3, np.full(len(grid), 1.15)))
    points = np.vstack((wall, top))
    spacing = np.full(len(points), SPACING)
    share = sunlit(scene[1], renderer="sun", points_W=points.T, spacing=spacing, direction=direction, reach=50.0)
    surely = np.any([meets_box(points, -direction, *box, -2 * SPACING) for box in BOXES], axis=0)
    perhaps = np.any([meets_box(points, -direction, *box, 2 * SPACING) for box in BOXES[1:]], axis=0)
    lit = ~perhaps & ((np.abs(points[:, :2]) < 0.95).all(axis=1))
    assert share[surely].max(initial=0.0) == 0.0
    assert lit.mean() > 0.5
    assert share[lit].min() == 1.0
    # Lower, the sun throws the shadows beside the wall.
    assert surely.mean() > 0.01 or angle_deg > 45.0


def test_no_points_have_no_shadows(scene: tuple) -> None:
    none = {"points_W": np.zeros((3, 0)), "spacing": np.zeros(0)}
    nothing = sunlit(scene[1], renderer="sun", **none, direction=(0.0, 0.0, -1.0), reach=50.0)
    assert nothing.shape == (0,)
