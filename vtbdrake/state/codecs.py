"""Codecs for values of the usual types, such as abstract ports carry: a value becomes named arrays, and back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from vtbdrake.state.element import Codec


def codec_of(model: Any, *, varying: bool = False) -> Codec:
    """The codec for values like ``model``, exact to the last bit.

    An array, a number, a text, a pose, a rotation, one of Drake's images or a point cloud is one array or a few; a
    dataclass is one array per field, by its name; its fields are arrays and numbers.

    Args:
        varying: arrays and images may have another size than ``model``. Else one of another size is refused.

    Raises:
        ValueError: there is none for its type.
    """
    if isinstance(model, np.ndarray) and not model.dtype.hasobject:
        return _any_array_codec() if varying else array_codec(model.shape, model.dtype)
    if isinstance(model, bool | int | float):
        return _number_codec(type(model))
    if isinstance(model, str):
        return Codec(_encode_text, _decode_text)
    if isinstance(model, RigidTransform):
        return Codec(lambda X_AB: {"": X_AB.GetAsMatrix34()}, _pose)
    if isinstance(model, RotationMatrix):
        return Codec(lambda R_AB: {"": R_AB.matrix()}, lambda arrays: RotationMatrix(arrays[""]))
    # Drake's images and point clouds, without the import of their modules, which a DPS alone may do without.
    if hasattr(model, "mutable_data"):
        return _image_codec(type(model), None if varying else model.data.shape)
    if hasattr(model, "mutable_xyzs"):
        return _cloud_codec(model)
    if is_dataclass(model) and not isinstance(model, type):
        return _dataclass_codec(model)
    raise ValueError(
        f"there is no codec for a {type(model).__name__}: make it an array, a number, a text, a pose, an image or a "
        "dataclass of arrays and numbers, or give a Codec"
    )


def array_codec(shape: tuple[int, ...], dtype: Any = float) -> Codec:
    """The codec for arrays of one shape and type."""

    def encode(value: Any) -> dict[str, np.ndarray]:
        array = np.asarray(value, dtype=dtype)
        if array.shape != shape:
            raise ValueError(f"an array of shape {shape} is expected here, not one of shape {array.shape}")
        return {"": array}

    return Codec(encode, lambda arrays: np.asarray(arrays[""]))


def _any_array_codec() -> Codec:
    def encode(value: Any) -> dict[str, np.ndarray]:
        if not isinstance(value, np.ndarray) or value.dtype.hasobject:
            raise ValueError(f"an array of numbers is expected here, not {value!r}")
        return {"": value}

    return Codec(encode, lambda arrays: np.array(arrays[""]))


def _number_codec(kind: type) -> Codec:
    def encode(value: Any) -> dict[str, np.ndarray]:
        array = np.asarray(value)
        if type(value) is not kind or array.dtype.hasobject:
            raise ValueError(f"a number of type {kind.__name__} and at most 64 bits is expected here, not {value!r}")
        return {"": array}

    return Codec(encode, lambda arrays: kind(arrays[""].item()))


def _encode_text(value: Any) -> dict[str, np.ndarray]:
    if not isinstance(value, str):
        raise ValueError(f"a text is expected here, not {value!r}")
    return {"": np.frombuffer(value.encode(errors="surrogatepass"), dtype=np.uint8)}


def _decode_text(arrays: Mapping[str, np.ndarray]) -> str:
    return arrays[""].tobytes().decode(errors="surrogatepass")


def _pose(arrays: Mapping[str, np.ndarray]) -> RigidTransform:
    matrix = arrays[""]
    return RigidTransform(RotationMatrix(matrix[:, :3]), matrix[:, 3])


def _image_codec(kind: type, shape: tuple[int, ...] | None) -> Codec:
    def encode(image: Any) -> dict[str, np.ndarray]:
        if shape is not None and image.data.shape != shape:
            raise ValueError(f"an image of shape {shape} is expected here, not one of shape {image.data.shape}")
        return {"": image.data}

    def decode(arrays: Mapping[str, np.ndarray]) -> Any:
        height, width = arrays[""].shape[:2]
        image = kind(width, height)
        image.mutable_data[:] = arrays[""]
        return image

    return Codec(encode, decode)


def _cloud_codec(model: Any) -> Codec:
    from pydrake.perception import BaseField, Fields

    kind, every = type(model), {"xyzs": BaseField.kXYZs, "normals": BaseField.kNormals, "rgbs": BaseField.kRGBs}
    parts = [part for part in every if getattr(model, f"has_{part}")()]
    declared = Fields(sum(int(every[part]) for part in parts))
    if model.fields() != declared:
        raise ValueError("there is no codec for a PointCloud with descriptors, which Python cannot read; give a Codec")

    def encode(cloud: Any) -> dict[str, np.ndarray]:
        if cloud.fields() != declared:
            raise ValueError(f"a point cloud with {', '.join(parts)} is expected here, not one with other fields")
        return {part: getattr(cloud, part)() for part in parts}

    def decode(arrays: Mapping[str, np.ndarray]) -> Any:
        cloud = kind(arrays[parts[0]].shape[1], declared)
        for part in parts:
            getattr(cloud, f"mutable_{part}")()[:] = arrays[part]
        return cloud

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
