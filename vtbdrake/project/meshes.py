"""Meshes in formats that Drake does not read, as OBJ files."""

from __future__ import annotations

import io
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from trimesh import Scene

CONVERTED = (".stl", ".dae", ".ply", ".glb")
"""The suffixes of the meshes that are converted."""

# What each needs beside trimesh.
_MODULES = {".dae": ("trimesh", "collada")}


class MeshError(ValueError):
    """A mesh cannot be converted."""


@dataclass
class _Piece:
    """A part of a mesh with one material."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    normals: NDArray[np.float64] | None = None  # for each vertex, or for each face
    uv: NDArray[np.float64] | None = None
    material: str = ""


def can_convert(path: Path) -> bool:
    """Return whether what is needed to convert a mesh is installed (the extra ``meshes``)."""
    return all(find_spec(module) for module in _MODULES.get(path.suffix.lower(), ("trimesh",)))


def convert(path: Path, stem: str, *, hull: bool = False) -> dict[str, bytes]:
    """Return a mesh as an OBJ file, with its materials where it has some.

    The axes are the file's, as RViz takes them; a COLLADA file's unit is converted to m.

    Args:
        path: The mesh.
        stem: The name of the OBJ file, ``stem.obj``, without suffix; the names of other files begin with it.
        hull: Whether its convex hull is wanted, which is what Drake's contact takes of a mesh.

    Returns:
        The files, by their names; the OBJ file is the first.

    Raises:
        MeshError: It cannot be read, or has no triangles.
    """
    scene = _load(path)
    if hull:
        mesh = scene.to_mesh()
        try:
            mesh = mesh.convex_hull
        except Exception as error:  # Qhull's errors have no common class; a flat mesh has no hull.
            raise MeshError(f"{path} has no convex hull: {str(error).splitlines()[0]}") from error
        return {f"{stem}.obj": _obj([_Piece(mesh.vertices, mesh.faces)])}
    return _with_materials(scene, stem)


def _load(path: Path) -> Scene:
    import trimesh

    try:
        scene = trimesh.load_scene(path, process=False)
    except Exception as error:  # trimesh and pycollada raise whatever the file makes them raise
        raise MeshError(f"{path} cannot be read: {type(error).__name__}: {str(error).splitlines()[:1]}") from error
    if not any(len(getattr(geometry, "faces", ())) for geometry in scene.geometry.values()):
        raise MeshError(f"{path} has no triangles")
    units = {geometry.metadata.get("units", "") for geometry in scene.geometry.values()}
    if len(units) == 1 and (unit := units.pop() or "").endswith(" * meters"):
        scene.apply_scale(float(unit.removesuffix(" * meters")))
    return scene


def _with_materials(scene: Scene, stem: str) -> dict[str, bytes]:
    materials: dict[str, str] = {}  # their text -> name
    textures: dict[bytes, str] = {}
    pieces = []
    for node in scene.graph.nodes_geometry:
        T, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not len(getattr(mesh, "faces", ())):
            continue
        is_mirrored = np.linalg.det(T[:3, :3]) < 0.0
        normals = mesh.vertex_normals if "vertex_normals" in mesh._cache else mesh.face_normals
        normals = normals @ np.linalg.inv(T[:3, :3])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        piece = _Piece(
            vertices=mesh.vertices @ T[:3, :3].T + T[:3, 3],
            faces=mesh.faces[:, ::-1] if is_mirrored else mesh.faces,
            normals=normals,
            uv=getattr(mesh.visual, "uv", None),
        )
        if (material := getattr(mesh.visual, "material", None)) is not None:
            text = _material(material, textures, stem, has_uv=piece.uv is not None)
            piece.material = materials.setdefault(text, f"m{len(materials)}")
        pieces.append(piece)
    files = {f"{stem}.obj": _obj(pieces, f"{stem}.mtl" if materials else "")}
    if materials:
        files[f"{stem}.mtl"] = "".join(f"newmtl {name}\n{text}" for text, name in materials.items()).encode()
    return files | {name: content for content, name in textures.items()}


def _material(material: Any, textures: dict[bytes, str], stem: str, *, has_uv: bool) -> str:
    """Return the text of a material in an MTL file; its texture is added to ``textures``, content -> name."""
    simple = material.to_simple() if hasattr(material, "to_simple") else material
    text = "Kd {:.4g} {:.4g} {:.4g}\nd {:.4g}\n".format(*np.asarray(simple.diffuse, float) / 255.0)
    if not (has_uv and simple.image is not None):
        return text
    image = io.BytesIO()
    simple.image.convert("RGBA" if "A" in simple.image.mode else "RGB").save(image, "PNG")
    return text + f"map_Kd {textures.setdefault(image.getvalue(), f'{stem}.{len(textures)}.png')}\n"


def _obj(pieces: list[_Piece], mtllib: str = "") -> bytes:
    """Return the text of an OBJ file; what vertices and faces have in common is written once."""
    lines = [f"mtllib {mtllib}\n"] if mtllib else []
    first = {"v": 1, "vt": 1, "vn": 1}

    def written(kind: str, pattern: str, rows: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.int64]:
        distinct, index = _distinct(rows)
        lines.append(f"{kind}{pattern * rows.shape[1]}\n" * len(distinct) % tuple(np.ravel(distinct).tolist()))
        first[kind] += len(distinct)
        return index[faces] + first[kind] - len(distinct)

    for piece in pieces:
        faces, slash = piece.faces, "/"
        columns = [written("v", " %.7g", piece.vertices, faces)]
        if piece.uv is not None and len(piece.uv) == len(piece.vertices):
            columns.append(written("vt", " %.6g", piece.uv[:, :2], faces))
        elif piece.normals is not None:
            slash = "//"
        if piece.normals is not None:
            is_of_faces = len(piece.normals) != len(piece.vertices)
            corners = np.repeat(np.arange(len(faces))[:, None], 3, axis=1) if is_of_faces else faces
            columns.append(written("vn", " %.4g", piece.normals, corners))
        lines += [f"usemtl {piece.material}\n"] if piece.material else []
        corner = " " + slash.join(["%d"] * len(columns))
        numbers = np.stack(columns, axis=-1).reshape(-1)
        lines.append(f"f{corner * 3}\n" * len(faces) % tuple(numbers.tolist()))
    return "".join(lines).encode()


def _distinct(rows: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return the rows that differ, and for each row its index among them."""
    values = np.ascontiguousarray(rows, np.float32) + np.float32(0.0)
    keys = values.view(np.dtype((np.void, values.dtype.itemsize * values.shape[1])))[:, 0]
    _, first, index = np.unique(keys, return_index=True, return_inverse=True)
    return values[first], np.ravel(index)
