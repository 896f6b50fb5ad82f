"""Codecs for values of the usual types, such as abstract ports carry: a value becomes named arrays, and back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from vtbdrake.state.element import Codec


def codec_of(model: Any) -> Codec:
    """The codec for values like ``model``, exact to the last bit.

    An array, a RigidTransform or one of Drake's images is one array, under the name ``""``; a dataclass is one array
    per field, by its name; its fields are arrays and numbers.

    Raises:
        ValueError: there is none for its type.
    """
    if isinstance(model, np.ndarray):
        return array_codec(model.shape, model.dtype)
    if isinstance(model, RigidTransform):
        return Codec(lambda X_AB: {"": X_AB.GetAsMatrix34()}, _pose)
    # Drake's images, without the import of its sensors, which a DPS alone may do without.
    if hasattr(model, "mutable_data"):
        return _image_codec(model)
    if is_dataclass(model) and not isinstance(model, type):
        return _dataclass_codec(model)
    raise ValueError(
        f"there is no codec for a {type(model).__name__}: make it an array, a pose, an image or a dataclass of arrays "
        "and numbers, or give a Codec"
    )


def array_codec(shape: tuple[int, ...], dtype: Any = float) -> Codec:
    """For arrays of one shape and type."""

    def encode(value: Any) -> dict[str, np.ndarray]:
        array = np.asarray(value, dtype=dtype)
        if array.shape != shape:
            raise ValueError(f"an array of shape {shape} is expected here, not one of shape {array.shape}")
        return {"": array}

    return Codec(encode, lambda arrays: np.asarray(arrays[""]))


def _pose(arrays: Mapping[str, np.ndarray]) -> RigidTransform:
    matrix = arrays[""]
    return RigidTransform(RotationMatrix(matrix[:, :3]), matrix[:, 3])


def _image_codec(model: Any) -> Codec:
    kind, shape = type(model), model.data.shape

    def encode(image: Any) -> dict[str, np.ndarray]:
        if image.data.shape != shape:
            raise ValueError(f"an image of shape {shape} is expected here, not one of shape {image.data.shape}")
        return {"": image.data}

    def decode(arrays: Mapping[str, np.ndarray]) -> Any:
        image = kind(shape[1], shape[0])
        image.mutable_data[:] = arrays[""]
        return image

    return Codec(encode, decode)


def _dataclass_codec(model: Any) -> Codec:
    kind = type(model)
    parts = {field.name: _part(kind, field.name, getattr(model, field.name)) for field in fields(model)}

    def encode(value: Any) -> dict[str, np.ndarray]:
        return {name: np.asarray(getattr(value, name)) for name in parts}

    def decode(arrays: Mapping[str, np.ndarray]) -> Any:
        return kind(**{name: restore(arrays[name]) for name, restore in parts.items()})

    return Codec(encode, decode)


def _part(owner: type, name: str, value: Any) -> Callable[[np.ndarray], Any]:
    if isinstance(value, np.ndarray):
        return np.asarray
    if isinstance(value, bool | int | float):
        number = type(value)
        return lambda array: number(array.item())
    raise ValueError(
        f"there is no codec for a {owner.__name__}: its field {name} is neither an array nor a number, but a "
        f"{type(value).__name__}; give a Codec"
    )
