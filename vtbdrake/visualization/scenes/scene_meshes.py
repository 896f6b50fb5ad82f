"""The surfaces of meshes as triangles, which every viewer shows alike."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Convex, Mesh, MeshcatCone

from vtbdrake.common.extras import extra_module
from vtbdrake.components.meshes import unit_cone
from vtbdrake.components.ray_casting import shape_surface

if TYPE_CHECKING:
    from pydrake.geometry import MeshSource

# What Drake turns a mesh in glTF by, in which y is upwards: (x, y, z) becomes (x, -z, y).
_R_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_GLTF = (".gltf", ".glb")
# Number of facets of a cone.
_SIDES = 32


@dataclass(frozen=True)
class TriangleMesh:
    """The surface of a mesh.

    Attributes:
        vertices: The vertices in m, shape (v, 3).
        triangles: The vertices of each triangle, counterclockwise from outside, shape (t, 3).
        colors: Red, green, blue and opacity of each vertex from 0 to 255, shape (v, 4); None: the mesh has none.
    """

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int32]
    colors: NDArray[np.uint8] | None = None


def triangle_mesh(shape: Mesh | Convex | MeshcatCone, name: str) -> TriangleMesh:
    """Return the surface of a mesh, of the convex hull of one, or of a cone, in its own frame.

    An .obj is read by Drake, without its materials; other files are read by trimesh, with colours at the vertices in
    place of materials and textures.

    Args:
        shape: The shape.
        name: The name of its geometry, for errors.

    Raises:
        ValueError: The file of the mesh cannot be read.
        ModuleNotFoundError: Files other than .obj need trimesh, which the extra ``meshes`` installs.
    """
    if isinstance(shape, MeshcatCone):  # Its tip is at the origin, and its base at z = height.
        vertices, triangles = unit_cone(_SIDES)
        scale, height = np.array([shape.a(), shape.b(), -shape.height()]), np.array([0.0, 0.0, shape.height()])
        return TriangleMesh(vertices * scale + height, triangles[:, ::-1].astype(np.int32))
    if isinstance(shape, Convex) or shape.extension() == ".obj":
        return TriangleMesh(*shape_surface(shape, name))
    purpose = f"the mesh '{name}' ({shape.extension()})"
    trimesh = extra_module("trimesh", purpose=purpose, extra="meshes")
    try:
        scene = _loaded(trimesh, shape.source())
        mesh = scene.to_mesh()
        visual = mesh.visual.to_color() if hasattr(mesh.visual, "to_color") else mesh.visual
        colors = None if visual.kind is None else np.asarray(visual.vertex_colors, dtype=np.uint8)
    except Exception as error:  # trimesh raises whatever the file makes it raise
        raise ValueError(f"{purpose} cannot be read: {type(error).__name__}: {str(error)[:200]}") from error
    R = _R_UP if shape.extension() in _GLTF else np.eye(3)
    vertices = np.asarray(mesh.vertices, dtype=float) @ R.T * shape.scale3()
    return TriangleMesh(vertices, np.asarray(mesh.faces, dtype=np.int32), colors)


def _loaded(trimesh: Any, source: MeshSource) -> Any:
    """Return the scene of a file, or of files in memory."""
    if source.is_path():
        return trimesh.load_scene(source.path(), process=False)
    memory = source.in_memory()
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"mesh{source.extension()}"
        path.write_bytes(memory.mesh_file.contents())
        for name, file in memory.supporting_files.items():
            other = Path(folder) / name
            other.write_bytes(file.contents() if hasattr(file, "contents") else Path(file).read_bytes())
        return trimesh.load_scene(path, process=False)
