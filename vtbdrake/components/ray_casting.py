"""Ray casting on the geometry of a plant: one Embree scene per rigid group, which moves while rays are fired."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import acos, ceil, cos, pi, sin
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vtbdrake.common.arrays import Array
from vtbdrake.common.extras import extra_module
from vtbdrake.components.ray_kernel import keep_nearest, to_body, to_world

if TYPE_CHECKING:
    from pydrake.geometry import Role, SceneGraph, Shape
    from pydrake.math import RigidTransform
    from pydrake.multibody.math import SpatialVelocity
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import RigidBody

# Vertices in m, shape (v, 3), and the triangles between them, shape (t, 3).
Surface = tuple[Array, NDArray[np.int32]]

# The largest distance of a facet below the curved surface that it approximates, in m.
TOLERANCE = 1e-4
# A half space is cast as a square of this side, in m: Embree computes with 32 bits.
HALF_SPACE = 2000.0


@dataclass(frozen=True)
class Hits:
    """The first hits of n rays.

    Attributes:
        distances: Distances from the origins of the rays in m, infinite where nothing is hit, shape (n,).
        cosines: Cosines of the angles of incidence, 0 where nothing is hit, shape (n,).
        bodies: Indices of the bodies that are hit (one of each rigid group), -1 where nothing is hit, shape (n,).
    """

    distances: Array
    cosines: Array
    bodies: NDArray[np.int32]


@dataclass(frozen=True)
class _WeldedBodies:
    """Bodies that are welded together, as one scene in the frame of one of them."""

    body: int
    scene: Any  # embreex has no types
    # Center and radius of a sphere, lower and upper corner of a box around it, in m.
    bounds: Array


class RayCaster:
    """Casts rays at the bodies of a plant, which move while the rays are fired.

    The geometry is the SceneGraph model's: boxes, spheres, ellipsoids, cylinders, capsules, half spaces, Convex
    shapes and meshes (OBJ), of the bodies of the plant and of the world. Embree casts rays at triangles, with 32 bits.
    So curved surfaces become facets, at most `TOLERANCE` below the surface, and a half space a square of the side
    `HALF_SPACE`. Bodies that are welded together share a scene; rays are transformed into its frame.

    A caster is built once per Diagram, and is immutable: contexts and threads share it. Geometry that is changed in a
    Context afterwards is not hit.

    Attributes:
        bodies: Index of the body in whose frame the scene is, for each rigid group.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        scene_graph: SceneGraph,
        *,
        role: Role | None = None,
        without: Sequence[RigidBody] = (),
    ) -> None:
        """Build the scenes.

        Args:
            plant: The finalized plant; it is not kept.
            scene_graph: The SceneGraph that it is registered with; it is not kept.
            role: The geometry to cast rays at; the perception role by default: a laser sees what a camera sees.
            without: Bodies that rays pass through.

        Raises:
            ModuleNotFoundError: Embree is not installed.
            ValueError: A geometry cannot be cast, or moves and does not belong to the plant.
        """
        embree = extra_module("embreex.rtcore", purpose="casting rays", extra="perception")
        surfaces = body_surfaces(plant, scene_graph, role=role, without=without)
        device = embree.EmbreeDevice()
        self._groups = tuple(_group(body, surfaces[body], device) for body in sorted(surfaces))
        self.bodies = tuple(group.body for group in self._groups)

    def cast(
        self,
        directions_L: Array,
        times: Array,
        *,
        X_WL: RigidTransform,
        V_WL: SpatialVelocity,
        X_WB: Sequence[RigidTransform],
        V_WB: Sequence[SpatialVelocity],
        reach: float = np.inf,
    ) -> Hits:
        """Return the first hits of rays from the origin of a moving frame L.

        Between the time 0 and the firing times, L and the bodies move with constant velocities.

        Args:
            directions_L: Unit vectors of the rays, in L at their firing times, shape (n, 3).
            times: Firing times of the rays in s, shape (n,).
            X_WL: Pose of L at the time 0.
            V_WL: Spatial velocity of L at the time 0.
            X_WB: Poses of all bodies at the time 0, by their indices.
            V_WB: Spatial velocities of all bodies at the time 0, by their indices.
            reach: The largest distance of a hit in m.
        """
        n = len(times)
        nearest, cosines, bodies = np.full(n, reach), np.zeros(n), np.full(n, -1, dtype=np.int32)
        times = np.ascontiguousarray(times)
        origins_W, directions_W = to_world(np.ascontiguousarray(directions_L), times, _motion(X_WL, V_WL))
        for group in self._groups:
            motion = _motion(X_WB[group.body], V_WB[group.body])
            origins, directions, limits, rays = to_body(origins_W, directions_W, times, motion, group.bounds, nearest)
            if not len(rays):
                continue
            hit = group.scene.run(origins, directions, limits, output=True)
            distances = np.where(hit["geomID"] < 0, np.float32(np.inf), hit["tfar"])
            keep_nearest(
                distances, hit["Ng"], directions, rays, group.body, nearest=nearest, cosines=cosines, bodies=bodies
            )
        nearest[bodies < 0] = np.inf
        return Hits(nearest, cosines, bodies)


def _motion(X_WB: RigidTransform, V_WB: SpatialVelocity) -> Array:
    """Return the motion of B in W as `ray_kernel` takes it, shape (18,)."""
    return np.concatenate(
        [X_WB.rotation().matrix().ravel(), X_WB.translation(), V_WB.rotational(), V_WB.translational()]
    )


def body_surfaces(
    plant: MultibodyPlant, scene_graph: SceneGraph, *, role: Role | None = None, without: Sequence[RigidBody] = ()
) -> dict[int, list[Surface]]:
    """Return the surfaces of every rigid group, by the index of the body in whose frame they are.

    Args:
        plant: The finalized plant.
        scene_graph: The SceneGraph that it is registered with.
        role: The role of the geometry; by default the perception role.
        without: Bodies to leave out.

    Raises:
        ValueError: A geometry cannot be cast, or moves and does not belong to the plant.
    """
    from pydrake.geometry import GeometrySet, Role

    role = Role.kPerception if role is None else role
    left_out = {int(body.index()) for body in without}
    inspector = scene_graph.model_inspector()
    context = plant.CreateDefaultContext()
    surfaces: dict[int, list[Surface]] = {}
    for geometry in inspector.GetGeometryIds(GeometrySet(inspector.GetAllGeometryIds()), role):
        name, frame = inspector.GetName(geometry), inspector.GetFrameId(geometry)
        body = plant.GetBodyFromFrameId(frame)
        if frame == inspector.world_frame_id():
            body = plant.world_body()
        if body is None:
            raise ValueError(
                f"the geometry '{name}' moves with the frame '{inspector.GetName(frame)}', which does not belong to "
                "the plant: rays are cast at bodies of the plant and at the world"
            )
        if int(body.index()) in left_out:
            continue
        group = min(plant.GetBodiesWeldedTo(body), key=lambda welded: int(welded.index()))
        X_GB = plant.CalcRelativeTransform(context, group.body_frame(), body.body_frame())
        vertices, triangles = shape_surface(inspector.GetShape(geometry), name)
        points = (X_GB @ inspector.GetPoseInFrame(geometry)) @ vertices.T
        surfaces.setdefault(int(group.index()), []).append((points.T, triangles))
    return surfaces


def _group(body: int, surfaces: Sequence[Surface], device: Any) -> _WeldedBodies:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene(device, robust=True)
    for vertices, triangles in surfaces:
        TriangleMesh(scene, vertices.astype(np.float32), triangles)
    corners = np.concatenate([vertices for vertices, _ in surfaces])
    # Embree rounds the corners.
    margin = 1e-4 + 1e-6 * np.abs(corners).max()
    lower, upper = corners.min(axis=0) - margin, corners.max(axis=0) + margin
    center = (lower + upper) / 2.0
    radius = margin + float(np.linalg.norm(corners - center, axis=1).max())
    # The first run builds the scene: afterwards nothing changes it, and threads can share it.
    scene.run(np.zeros((1, 3), dtype=np.float32), np.ones((1, 3), dtype=np.float32))
    return _WeldedBodies(body, scene, np.concatenate([center, [radius], lower, upper]))


def shape_surface(shape: Shape, name: str) -> Surface:
    """Return the surface of a shape in its own frame: vertices in m, (v, 3), and triangles, (t, 3).

    Args:
        shape: The shape; a mesh is one of an .obj file.
        name: The name of its geometry, for the error.

    Raises:
        ValueError: Rays cannot be cast at such a shape.
    """
    kind = type(shape).__name__
    if kind not in _KINDS:
        raise ValueError(f"rays cannot be cast at the geometry '{name}', a {kind}: use {', '.join(_KINDS)}")
    return _KINDS[kind](shape, name)


def _box(box: Any, name: str) -> Surface:
    corners = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners * box.size(), _fans(quads)


def _half_space(half_space: Any, name: str) -> Surface:
    s = HALF_SPACE / 2.0
    return np.array([(-s, -s, 0.0), (s, -s, 0.0), (s, s, 0.0), (-s, s, 0.0)]), _fans([(0, 1, 2, 3)])


def _cylinder(cylinder: Any, name: str) -> Surface:
    r, h = cylinder.radius(), cylinder.length() / 2.0
    return _revolved([(0.0, -h), (r, -h), (r, h), (0.0, h)])


def _capsule(capsule: Any, name: str) -> Surface:
    r, h = capsule.radius(), capsule.length() / 2.0
    arc = _arc(r)
    return _revolved([(x, z + (h if z > 0.0 else -h)) for x, z in arc])


def _sphere(sphere: Any, name: str) -> Surface:
    return _revolved(_arc(sphere.radius()))


def _ellipsoid(ellipsoid: Any, name: str) -> Surface:
    axes = np.array([ellipsoid.a(), ellipsoid.b(), ellipsoid.c()])
    vertices, triangles = _revolved(_arc(axes.max()))
    return vertices * (axes / axes.max()), triangles


def _convex(shape: Any, name: str) -> Surface:
    hull = shape.GetConvexHull()
    faces, data, k = [], hull.face_data(), 0
    while k < len(data):
        faces.append(data[k + 1 : k + 1 + data[k]])
        k += 1 + data[k]
    return np.array([hull.vertex(k) for k in range(hull.num_vertices())]), _fans(faces)


def _mesh(shape: Any, name: str) -> Surface:
    if shape.extension() != ".obj":
        raise ValueError(f"rays cannot be cast at the geometry '{name}', a mesh of type {shape.extension()}: use .obj")
    source = shape.source()
    if source.is_path():
        return _read(source.path(), shape.scale3())
    contents = source.in_memory().mesh_file.contents()
    is_mirrored = (shape.scale3() < 0.0).any()  # Then Drake turns the triangles around.
    if not is_mirrored and (surface := _triangles_alone(contents.decode(errors="replace"))):
        return surface[0] * shape.scale3(), surface[1]
    with TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.obj"
        path.write_bytes(contents)
        return _read(path, shape.scale3())


def _triangles_alone(text: str) -> Surface | None:
    """Return the surface in a text as `obj_mesh` writes it, or None if it is more than vertices, normals and triangles.

    From Drake's reader, each corner of each triangle comes to Python by a call of its own: that takes longer.
    """
    words = text.split()
    kinds = words[::4]  # Each line has four words: what it is, and three numbers.
    v, vn, f = (kinds.count(kind) for kind in ("v", "vn", "f"))
    if not v or not f or kinds != ["v"] * v + ["vn"] * vn + ["f"] * f or len(words) % 4:
        return None
    try:
        vertices = np.column_stack([[float(word) for word in words[k : 4 * v : 4]] for k in (1, 2, 3)])
        corners = [[int(word.partition("/")[0]) for word in words[4 * (v + vn) + k :: 4]] for k in (1, 2, 3)]
    except ValueError:
        return None
    triangles = np.column_stack(corners).astype(np.int32) - np.int32(1)
    return (vertices, triangles) if 0 <= triangles.min() <= triangles.max() < v else None


def _read(path: Path, scale: Array) -> Surface:
    from pydrake.geometry import ReadObjToTriangleSurfaceMesh

    mesh = ReadObjToTriangleSurfaceMesh(path, scale)
    triangles = [[triangle.vertex(k) for k in range(3)] for triangle in mesh.triangles()]
    return np.array(mesh.vertices()), np.array(triangles, dtype=np.int32)


_KINDS: dict[str, Callable[[Any, str], Surface]] = {
    "Box": _box,
    "Capsule": _capsule,
    "Convex": _convex,
    "Cylinder": _cylinder,
    "Ellipsoid": _ellipsoid,
    "HalfSpace": _half_space,
    "Mesh": _mesh,
    "Sphere": _sphere,
}


def _fans(faces: Sequence[Sequence[int]]) -> NDArray[np.int32]:
    """Return the triangles of convex polygons."""
    return np.array([(f[0], f[k], f[k + 1]) for f in faces for k in range(1, len(f) - 1)], dtype=np.int32)


def _segments(radius: float) -> int:
    """Return the number of chords of a circle within half the `TOLERANCE`, as facets approximate two curvatures."""
    return max(16, ceil(pi / acos(max(0.0, 1.0 - TOLERANCE / 2.0 / radius))))


def _arc(radius: float) -> list[tuple[float, float]]:
    """Return points of a half circle from (0, -radius) to (0, radius), where two lie beside z = 0."""
    count = _segments(radius) // 2 | 1
    angles = [-pi / 2.0 + pi * k / count for k in range(1, count)]
    return [(0.0, -radius), *((radius * cos(a), radius * sin(a)) for a in angles), (0.0, radius)]


def _revolved(profile: Sequence[tuple[float, float]]) -> Surface:
    """Return the surface of revolution about z of a profile of points (r, z), which begins and ends at r = 0."""
    n = _segments(max(r for r, _ in profile))
    circle = [(cos(2.0 * pi * k / n), sin(2.0 * pi * k / n)) for k in range(n)]
    vertices = [(r * x, r * y, z) for r, z in profile for x, y in circle]
    faces = [
        (ring * n + k, ring * n + (k + 1) % n, (ring + 1) * n + (k + 1) % n, (ring + 1) * n + k)
        for ring in range(len(profile) - 1)
        for k in range(n)
    ]
    return np.array(vertices), _fans(faces)
