"""Textures: procedural images of bark and soil, and meshes in memory that wear an image.

Cameras that measure distances by comparing two images need surfaces that look different from place to place.
"""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from pydrake.geometry import Mesh

Array = NDArray[np.float64]

# Where the brightness of a procedural texture lies for 95 of 100 pixels, as a share of its colour.
_CONTRAST = 0.45
_BARK, _SOIL = (150.0, 125.0, 100.0), (125.0, 110.0, 80.0)


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
    from pydrake.common import MemoryFile
    from pydrake.geometry import InMemoryMesh, Mesh

    corners = np.repeat(np.asarray(triangles, dtype=np.int64) + 1, 3, axis=1)
    lines = ["mtllib texture.mtl", "usemtl texture"]
    for line, rows in (
        ("v %.9f %.9f %.9f", vertices),
        ("vn %.9f %.9f %.9f", normals),
        ("vt %.9f %.9f", coordinates),
        ("f %d/%d/%d %d/%d/%d %d/%d/%d", corners),
    ):
        lines += [line % tuple(row) for row in np.asarray(rows).tolist()]
    material = "newmtl texture\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nmap_Kd texture.png\n"
    files = {
        "texture.mtl": MemoryFile(material.encode(), ".mtl", "texture.mtl"),
        "texture.png": MemoryFile(png(image), ".png", "texture.png"),
    }
    obj = MemoryFile("\n".join([*lines, ""]).encode(), ".obj", "texture.obj")
    return Mesh(InMemoryMesh(mesh_file=obj, supporting_files=files))


def png(image: NDArray[np.uint8]) -> bytes:
    """Return an image, shape (h, w, 3), or (h, w) if grey, as a PNG file in colours, as every renderer reads it."""
    rgb = np.ascontiguousarray(np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image, dtype=np.uint8)
    height, width = rgb.shape[:2]
    rows = b"".join(b"\0" + row.tobytes() for row in rgb)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def bark(pixels: int = 512, *, seed: int = 0) -> NDArray[np.uint8]:
    """Return a square image of bark that repeats without a seam, shape (pixels, pixels, 3): long fissures, upright.

    Meant for about 2 m of trunk: then its finest fissures are 2 cm wide.
    """
    return _coloured(_noise(pixels, seed=seed, finest=100.0, stretch=4.0), _BARK)


def soil(pixels: int = 512, *, seed: int = 0) -> NDArray[np.uint8]:
    """Return a square image of litter and soil that repeats without a seam, shape (pixels, pixels, 3).

    Meant for about 4 m of ground: then its finest spots are 4 cm wide.
    """
    return _coloured(_noise(pixels, seed=seed, finest=100.0, stretch=1.0), _SOIL)


def _noise(pixels: int, *, seed: int, finest: float, stretch: float) -> Array:
    """Return periodic noise of unit variance, (pixels, pixels); amplitudes fall with the root of the frequency.

    Args:
        pixels: The edge of the image.
        seed: Determines it.
        finest: The highest frequency, in waves along the width of the image.
        stretch: How many times longer than wide its spots are.
    """
    spectrum = np.fft.rfft2(np.random.default_rng(seed).normal(size=(pixels, pixels)))
    along, across = np.fft.fftfreq(pixels, 1.0 / pixels), np.fft.rfftfreq(pixels, 1.0 / pixels)
    frequency = np.hypot(stretch * along[:, None], across)
    spectrum *= np.exp(-((frequency / finest) ** 2)) / np.maximum(frequency, 1.0) ** 0.5
    spectrum[0, 0] = 0.0
    noise = np.fft.irfft2(spectrum, s=(pixels, pixels))
    return np.asarray(noise / noise.std())


def _coloured(noise: Array, colour: tuple[float, float, float]) -> NDArray[np.uint8]:
    brightness = 1.0 + 0.5 * _CONTRAST * noise
    return np.clip(np.rint(brightness[..., None] * colour), 0.0, 255.0).astype(np.uint8)
