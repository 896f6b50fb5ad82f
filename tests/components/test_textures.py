"""Textures, as a decoder and a renderer see them."""

from __future__ import annotations

import numpy as np
import pytest

from vtbdrake.components.textures import bark, png, soil

cv2 = pytest.importorskip("cv2")


def test_png_holds_the_colours() -> None:
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    decoded = cv2.imdecode(np.frombuffer(png(image), dtype=np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(decoded[..., ::-1], image)
    grey = cv2.imdecode(np.frombuffer(png(image[..., 0]), dtype=np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(grey, np.repeat(image[..., :1], 3, axis=2))


@pytest.mark.parametrize("texture", [bark, soil])
def test_textures_repeat_without_a_seam(texture) -> None:
    image = texture(seed=2).astype(float)
    for axis in (0, 1):
        inside = np.abs(np.diff(image, axis=axis)).mean()
        seam = np.abs(np.take(image, 0, axis) - np.take(image, -1, axis)).mean()
        assert 0.5 * inside < seam < 2.0 * inside
    assert np.array_equal(texture(seed=2), texture(seed=2))
    assert not np.array_equal(texture(seed=2), texture(seed=3))


def test_fissures_of_bark_are_upright() -> None:
    image = bark()[..., 0].astype(float)
    assert np.abs(np.diff(image, axis=1)).mean() > 2.0 * np.abs(np.diff(image, axis=0)).mean()
