"""Textures: procedural images, and meshes in memory whose surface shows an image.

Cameras that measure distances by comparing two images need surfaces that look different from place to place.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vtbdrake.components.meshes import Surface, obj_lines, vertex_normals

if TYPE_CHECKING:
    from pydrake.geometry import Mesh


# Highest frequency of the grain of an image, in waves per pixel.
_FINEST = 0.2
# Standard deviation of the brightness, as a share of its mean.
_CONTRAST = 0.22


def textured_mesh(
    vertices: ArrayLike, *, normals: ArrayLike, coordinates: ArrayLike, triangles: ArrayLike, image: NDArray[np.uint8]
) -> Mesh:
    """Return a mesh in memory whose surface shows an image.

    Args:
        vertices: The vertices in m, shape (v, 3).
        normals: Unit vectors away from the surface at the vertices, shape (v, 3).
        coordinates: Where in the image each vertex lies, shape (v, 2): (0, 0) is its lower left corner, (1, 1) its
            upper right one. Renderers do not repeat it beyond.
        triangles: Indices of three vertices each, counterclockwise seen from outside, shape (t, 3).
        image: Colours, shape (h, w, 3), or greys, shape (h, w).
    """
    corners = np.repeat(np.asarray(triangles, dtype=np.int64)[..., np.newaxis], 3, axis=2)
    return _mesh(vertices, coordinates, normals, corners, image)


def _mesh(
    vertices: ArrayLike, coordinates: ArrayLike, normals: ArrayLike, corners: ArrayLike, image: NDArray[np.uint8]
) -> Mesh:
    """Return a mesh of triangles whose corners have a vertex, coordinates and a normal each: indices (t, 3, 3)."""
    from pydrake.common import MemoryFile
    from pydrake.geometry import InMemoryMesh, Mesh

    obj = "mtllib texture.mtl\nusemtl texture\n"
    obj += obj_lines("v %.9f %.9f %.9f", np.asarray(vertices)) + obj_lines("vt %.9f %.9f", np.asarray(coordinates))
    obj += obj_lines("vn %.9f %.9f %.9f", np.asarray(normals))
    obj += obj_lines("f %d/%d/%d %d/%d/%d %d/%d/%d", np.asarray(corners) + 1)
    material = "newmtl texture\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nmap_Kd texture.png\n"
    files = {
        "texture.mtl": MemoryFile(material.encode(), ".mtl", "texture.mtl"),
        "texture.png": MemoryFile(png(image), ".png", "texture.png"),
    }
    return Mesh(InMemoryMesh(mesh_file=MemoryFile(obj.encode(), ".obj", "texture.obj"), supporting_files=files))


def tiled_mesh(surface: Surface, *, image: NDArray[np.uint8], tile: tuple[float, float]) -> Mesh:
    """Return a surface as a mesh that is tiled with an image, along the two axes that each triangle faces least.

    So upright surfaces show the image upright, and each place of a surface in space shows another part of it.

    Args:
        surface: Vertices in m and triangles.
        image: Colours, shape (h, w, 3), that repeat without a seam.
        tile: The extent of the image in m, across and (on upright surfaces) along z. No triangle extends farther.

    Raises:
        ValueError: A triangle is larger than the image.
    """
    vertices, indices = surface
    points = vertices[indices]
    facing = np.abs(np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]))
    axes = np.array([[1, 2], [0, 2], [0, 1]])[np.argmax(facing, axis=1)]
    across = np.take_along_axis(points, axes[:, np.newaxis, :], axis=2) / tile
    folded = across - np.floor(across.min(axis=1, keepdims=True))
    if folded.max(initial=0.0) > 2.0:
        extent = np.ptp(across, axis=1).max(axis=0) * tile
        raise ValueError(
            f"a triangle extends over {extent[0]:.3g} x {extent[1]:.3g} m, more than the image of {tile[0]:g} x "
            f"{tile[1]:g} m: give a larger tile, or divide the triangle"
        )
    corners = np.stack([indices, np.arange(indices.size).reshape(-1, 3), indices], axis=-1)
    # Renderers do not repeat an image: here it is twice as wide and high, so that a triangle may cross its edges.
    return _mesh(vertices, 0.5 * folded.reshape(-1, 2), vertex_normals(surface), corners, np.tile(image, (2, 2, 1)))


def png(image: NDArray[np.uint8]) -> bytes:
    """Return an image, shape (h, w, 3), or (h, w) if grey, as a PNG file in colours, as every renderer reads it."""
    from pydrake.systems.sensors import ImageFileFormat, ImageIo, ImageRgb8U

    height, width = image.shape[:2]
    picture = ImageRgb8U(width, height)
    picture.mutable_data[:] = image.reshape(height, width, -1)
    return bytes(ImageIo().Save(picture, ImageFileFormat.kPng))


def grain(color: ArrayLike, *, seed: int = 0) -> NDArray[np.uint8]:
    """Return a square image of spots of all sizes that repeats without a seam, shape (512, 512, 3).

    Its brightness is noise whose amplitudes fall with the square root of the frequency; the smallest spots are about
    three pixels wide. On a tile that is higher than wide, it resembles bark.

    Args:
        color: The mean red, green and blue, from 0 to 1, shape (3,).
        seed: Determines the spots.
    """
    pixels = 512
    spectrum = np.fft.rfft2(np.random.default_rng(seed).normal(size=(pixels, pixels)))
    frequency = np.hypot(np.fft.fftfreq(pixels)[:, np.newaxis], np.fft.rfftfreq(pixels))
    spectrum *= np.exp(-((frequency / _FINEST) ** 2)) / np.maximum(frequency, 1.0 / pixels) ** 0.5
    spectrum[0, 0] = 0.0
    noise = np.fft.irfft2(spectrum, s=(pixels, pixels))
    brightness = 255.0 * (1.0 + _CONTRAST * noise / noise.std())
    return np.clip(np.rint(brightness[..., np.newaxis] * np.asarray(color)), 0.0, 255.0).astype(np.uint8)
