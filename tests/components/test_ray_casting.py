"""Rays hit what analytic geometry says, at rest and while everything moves."""

import sys
from collections.abc import Callable
from math import inf
from pathlib import Path

import numpy as np
import pytest
from pydrake.common import MemoryFile
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    GeometryFrame,
    GeometryInstance,
    HalfSpace,
    InMemoryMesh,
    Mesh,
    MeshcatCone,
    PerceptionProperties,
    ReadObjToTriangleSurfaceMesh,
    Role,
    SceneGraph,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import DiagramBuilder

from vtbdrake.common.arrays import Array
from vtbdrake.components.meshes import obj_mesh, unit_sphere
from vtbdrake.components.ray_casting import TOLERANCE, Hits, RayCaster, shape_surface

AT_REST = SpatialVelocity.Zero()
X_BG = RigidTransform(RollPitchYaw(0.4, -0.3, 0.8), [0.1, -0.2, 0.05])
TETRAHEDRON = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)])
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def plant_with(*shapes: Shape, X_BG: RigidTransform | None = None) -> tuple[MultibodyPlant, SceneGraph]:
    """A plant with one floating body per shape."""
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), time_step=0.0)
    for k, shape in enumerate(shapes):
        body = plant.AddRigidBody(f"body{k}", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        plant.RegisterVisualGeometry(body, X_BG or RigidTransform(), shape, f"shape{k}", [1.0, 1.0, 1.0, 1.0])
    plant.Finalize()
    return plant, scene_graph


def around_x(n: int, *, half_angle: float) -> Array:
    """Random directions in a pyramid around x."""
    y, z = np.tan(half_angle) * np.random.default_rng(0).uniform(-1.0, 1.0, (2, n))
    directions = np.stack([np.ones(n), y, z], axis=1)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def still(
    caster: RayCaster, directions: Array, X_WL: RigidTransform, *poses: RigidTransform, reach: float = inf
) -> Hits:
    X_WB = [RigidTransform(), *poses]
    motion = {"X_WL": X_WL, "V_WL": AT_REST, "X_WB": X_WB, "V_WB": [AT_REST] * len(X_WB)}
    return caster.cast(directions, np.zeros(len(directions)), **motion, reach=reach)


# Signed distances from the surfaces. The second implementation: where a ray hits, this is zero, and before it positive.


def rounded(q: Array) -> Array:
    return np.linalg.norm(np.maximum(q, 0.0), axis=-1) + np.minimum(q.max(axis=-1), 0.0)


def cylinder(p: Array) -> Array:
    return rounded(np.stack([np.hypot(p[..., 0], p[..., 1]) - 0.3, np.abs(p[..., 2]) - 0.4], axis=-1))


def capsule(p: Array) -> Array:
    z = p[..., 2] - np.clip(p[..., 2], -0.4, 0.4)
    return np.sqrt(p[..., 0] ** 2 + p[..., 1] ** 2 + z**2) - 0.3


def tetrahedron(p: Array) -> Array:
    return np.maximum(-p.min(axis=-1), (p.sum(axis=-1) - 1.0) / np.sqrt(3.0))


SHAPES: dict[str, tuple[Shape, Callable[[Array], Array]]] = {
    "box": (Box(0.4, 0.6, 0.8), lambda p: rounded(np.abs(p) - [0.2, 0.3, 0.4])),
    "sphere": (Sphere(0.5), lambda p: np.linalg.norm(p, axis=-1) - 0.5),
    "cylinder": (Cylinder(0.3, 0.8), cylinder),
    "capsule": (Capsule(0.3, 0.8), capsule),
    # Not a distance, but of the same sign and as steep at the surface, or less.
    "ellipsoid": (Ellipsoid(0.3, 0.4, 0.5), lambda p: 0.3 * (np.linalg.norm(p / [0.3, 0.4, 0.5], axis=-1) - 1.0)),
    "half space": (HalfSpace(), lambda p: p[..., 2]),
    "convex": (Convex(TETRAHEDRON.T, "tetrahedron"), tetrahedron),
    "mesh": (Mesh(InMemoryMesh(mesh_file=MemoryFile(OBJ, ".obj", "tetrahedron"))), tetrahedron),
}


@pytest.mark.parametrize("name", SHAPES)
def test_first_hits_lie_on_the_surface(name: str) -> None:
    shape, distance = SHAPES[name]
    caster = RayCaster(*plant_with(shape, X_BG=X_BG))
    X_WB = RigidTransform(RollPitchYaw(0.3, 0.5, -0.7), [1.0, 2.0, 3.0])
    X_WG = X_WB @ X_BG
    # From outside, 2 m above the plane and 1.5 m beside the axis.
    p_WL = X_WG @ np.array([1.5, 0.2, 2.0])
    to_center = X_WG.translation() - p_WL
    X_WL = RigidTransform(RotationMatrix.MakeFromOneVector(to_center / np.linalg.norm(to_center), 0), p_WL)
    directions = around_x(2000, half_angle=0.3)
    hits = still(caster, directions, X_WL, X_WB)

    struck = np.isfinite(hits.distances)
    assert struck.sum() > 200
    assert (hits.bodies == np.where(struck, 1, -1)).all()
    reach = np.where(struck, hits.distances, 5.0)
    steps = np.linspace(0.0, 1.0, 400)[:, np.newaxis, np.newaxis] * (reach[:, np.newaxis] * directions)
    along = distance(np.moveaxis((X_WG.inverse() @ X_WL @ steps.reshape(-1, 3).T), 0, -1).reshape(steps.shape))
    assert np.abs(along[-1, struck]).max() < TOLERANCE
    # Facets are below the surface, so that rays pass through its outermost layer.
    assert along.min() > -1.1 * TOLERANCE


@pytest.mark.parametrize("name", ["box", "sphere", "capsule"])
def test_incidence_is_that_of_the_gradient(name: str) -> None:
    shape, distance = SHAPES[name]
    caster = RayCaster(*plant_with(shape))
    directions, X_WL = around_x(500, half_angle=0.1), RigidTransform([-2.0, 0.05, 0.02])
    hits = still(caster, directions, X_WL, RigidTransform())
    points = X_WL.translation() + hits.distances[:, np.newaxis] * directions
    gradient = [(distance(points + h) - distance(points - h)) / 2e-6 for h in 1e-6 * np.eye(3)]
    # A facet has the normal of the surface up to half the angle between two facets.
    assert np.abs(hits.cosines - np.abs(np.sum(np.array(gradient).T * directions, axis=1))).max() < 0.03


def test_nearest_body_is_hit_whatever_their_order() -> None:
    caster = RayCaster(*plant_with(Sphere(0.5), Sphere(0.5), Sphere(0.5)))
    along_x = np.array([[1.0, 0.0, 0.0]])
    for nearest in (1, 2, 3):
        poses = [RigidTransform([2.0 if k == nearest else 4.0, 0.0, 0.0]) for k in (1, 2, 3)]
        hits = still(caster, along_x, RigidTransform(), *poses)
        assert hits.bodies[0] == nearest
        assert hits.distances[0] == pytest.approx(1.5, abs=TOLERANCE)


def test_nothing_is_hit_beyond_the_reach() -> None:
    caster = RayCaster(*plant_with(Sphere(0.5)))
    away, X_WB = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), RigidTransform([2.0, 0.0, 0.0])
    near, far = (still(caster, away, RigidTransform(), X_WB, reach=reach).distances for reach in (1.4, 1.6))
    assert np.isinf(near).all()
    assert np.isfinite(far).tolist() == [True, False]


def test_each_ray_sees_the_bodies_at_its_own_time() -> None:
    """A box turns and flies past a turning and flying origin: the same as a ray at a time, at rest."""
    caster = RayCaster(*plant_with(Box(1.0, 1.0, 1.0)))
    directions, times = around_x(60, half_angle=0.1), np.linspace(-0.6, 0.2, 60)
    X_WL = RigidTransform(RollPitchYaw(0.1, 0.2, 0.3), [0.1, 0.2, 0.3])
    V_WL = SpatialVelocity(w=[0.05, -0.1, 0.2], v=[0.1, 0.3, -0.2])
    X_WB = RigidTransform(RollPitchYaw(1.0, -0.5, 0.2), X_WL @ np.array([3.0, 0.0, 0.0]))
    V_WB = SpatialVelocity(w=[1.0, -2.0, 0.7], v=[-0.3, 0.2, -0.1])
    X_WW = RigidTransform()
    moving = caster.cast(directions, times, X_WL=X_WL, V_WL=V_WL, X_WB=[X_WW, X_WB], V_WB=[AT_REST, V_WB])

    def at(X: RigidTransform, V: SpatialVelocity, t: float) -> RigidTransform:
        w = V.rotational()
        turn = RotationMatrix(AngleAxis(t * np.linalg.norm(w), w / np.linalg.norm(w)))
        return RigidTransform(turn @ X.rotation(), X.translation() + t * V.translational())

    expected = [
        still(caster, directions[k : k + 1], at(X_WL, V_WL, t), at(X_WB, V_WB, t)).distances[0]
        for k, t in enumerate(times)
    ]
    np.testing.assert_allclose(moving.distances, expected, atol=5e-6)
    assert np.ptp(still(caster, directions, X_WL, X_WB).distances - moving.distances) > 0.1


def test_body_on_a_turning_arm_is_hit_where_it_was() -> None:
    """A sphere circles at 2 m; half a second before, it was 3 m from where it is at the time of the poses."""
    caster = RayCaster(*plant_with(Sphere(0.3), X_BG=RigidTransform([2.0, 0.0, 0.0])))
    angle = 3.0 * -0.5
    center = 2.0 * np.array([np.cos(angle), np.sin(angle), 0.0])
    X_WL = RigidTransform(center - [0.0, 5.0, 0.0])
    V_WB = SpatialVelocity(w=[0.0, 0.0, 3.0], v=[0.0, 0.0, 0.0])
    motion = {"X_WL": X_WL, "V_WL": AT_REST, "X_WB": [RigidTransform()] * 2, "V_WB": [AT_REST, V_WB]}
    hits = caster.cast(np.array([[0.0, 1.0, 0.0]]), np.array([-0.5]), **motion)
    np.testing.assert_allclose(hits.distances, [4.7], atol=1e-3)


def test_welded_bodies_and_the_world_are_scenes_of_their_own() -> None:
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), time_step=0.0)
    inertia, white = SpatialInertia.SolidSphereWithMass(1.0, 0.1), [1.0, 1.0, 1.0, 1.0]
    hull, antenna, floor = (plant.AddRigidBody(name, inertia) for name in ("hull", "antenna", "floor"))
    plant.WeldFrames(hull.body_frame(), antenna.body_frame(), RigidTransform([0.0, 2.0, 0.0]))
    plant.WeldFrames(plant.world_frame(), floor.body_frame(), RigidTransform([0.0, -5.0, 0.0]))
    for body in (hull, antenna, floor):
        plant.RegisterVisualGeometry(body, RigidTransform(), Sphere(0.5), "sphere", white)
    plant.Finalize()
    # Terrain that does not belong to the plant.
    source = scene_graph.RegisterSource("terrain")
    terrain = scene_graph.RegisterAnchoredGeometry(
        source, GeometryInstance(RigidTransform([0.0, 5.0, 0.0]), Sphere(0.5), "rock")
    )
    scene_graph.AssignRole(source, terrain, PerceptionProperties())

    caster = RayCaster(plant, scene_graph)
    assert caster.bodies == (0, int(hull.index()))
    poses = [RigidTransform()] * plant.num_bodies()
    poses[int(hull.index())] = RigidTransform([4.0, 0.0, 0.0])
    aims = [(4.0, 0.0, 0.0), (4.0, 2.0, 0.0), (0.0, -5.0, 0.0), (0.0, 5.0, 0.0)]
    lengths = np.linalg.norm(aims, axis=1)
    hits = still(caster, aims / lengths[:, np.newaxis], RigidTransform(), *poses[1:])
    np.testing.assert_allclose(hits.distances, lengths - 0.5, atol=TOLERANCE)

    assert RayCaster(plant, scene_graph, without=[hull, antenna]).bodies == (0,)


def test_two_casters_agree_to_the_last_bit() -> None:
    plant, scene_graph = plant_with(Capsule(0.3, 0.8), Sphere(0.2))
    directions, poses = around_x(1000, half_angle=0.3), [RigidTransform([2.0, 0, 0]), RigidTransform([1.5, 0.1, 0])]
    hits = [still(RayCaster(plant, scene_graph), directions, RigidTransform(), *poses) for _ in range(2)]
    assert hits[0].distances.tobytes() == hits[1].distances.tobytes()


@pytest.mark.parametrize(
    "kind", ["normals", "no normals", "scaled", "mirrored", "quadrilaterals", "comments", "counted from the end"]
)
def test_mesh_in_memory_is_the_one_that_drake_reads_from_a_file(kind: str, tmp_path: Path) -> None:
    vertices, triangles = unit_sphere(1)
    faces = [(0, 1, 2, 3), (4, 5, 6)] if kind == "quadrilaterals" else triangles
    mesh = obj_mesh(vertices, faces, normals=vertices if kind == "normals" else None)
    text = mesh.mesh_file.contents().decode()
    if kind == "comments":
        text = f"# A sphere of radius 1\n{text}"
    elif kind == "counted from the end":
        text = "\n".join(text.splitlines()[:-1]) + "\nf -3 -2 -1\n"
    scale = {"scaled": [1.0, 2.0, 3.0], "mirrored": [1.0, -2.0, 3.0]}.get(kind, [1.0, 1.0, 1.0])
    file = tmp_path / "mesh.obj"
    file.write_text(text)
    expected = ReadObjToTriangleSurfaceMesh(file, scale)
    in_memory = InMemoryMesh(mesh_file=MemoryFile(text, ".obj", "sphere"))
    points, corners = shape_surface(Mesh(in_memory, scale), "sphere")
    np.testing.assert_allclose(points, expected.vertices(), rtol=1e-15, atol=0.0)
    assert corners.tolist() == [[t.vertex(k) for k in range(3)] for t in expected.triangles()]


def test_shapes_that_cannot_be_cast_are_named() -> None:
    with pytest.raises(ValueError, match="'.*shape0', a MeshcatCone: use Box, "):
        RayCaster(*plant_with(MeshcatCone(1.0, 0.5, 0.5)))


def test_geometry_outside_the_plant_may_not_move() -> None:
    plant, scene_graph = plant_with(Sphere(0.5))
    source = scene_graph.RegisterSource("mobile")
    frame = scene_graph.RegisterFrame(source, GeometryFrame("cart"))
    wheel = scene_graph.RegisterGeometry(source, frame, GeometryInstance(RigidTransform(), Sphere(0.5), "wheel"))
    scene_graph.AssignRole(source, wheel, PerceptionProperties())
    with pytest.raises(ValueError, match=r"'wheel' moves with the frame 'cart', which does not belong to the plant"):
        RayCaster(plant, scene_graph)


def test_role_selects_the_geometry() -> None:
    assert RayCaster(*plant_with(Sphere(0.5)), role=Role.kProximity).bodies == ()


def test_missing_embree_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "embreex.rtcore", None)
    with pytest.raises(ImportError, match=r"pip install 'vtbdrake\[perception\]'"):
        RayCaster(*plant_with(Sphere(0.5)))
