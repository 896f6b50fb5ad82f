"""Codecs: abstract values and abstract state as named arrays, and back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import cached_property
from inspect import getattr_static
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, System
from pydrake.systems.primitives import DiscreteTimeDelay

from vtbdrake.common.failures import error_text
from vtbdrake.state.declarations import Codec
from vtbdrake.state.systems import class_name, is_camera, is_plant, is_scene_graph


def codec_of(model: Any, *, varying: bool = False) -> Codec:
    """Return the codec for values like ``model``, exact to the last bit.

    There are codecs for arrays, numbers, texts, poses, rotations, Drake's images and point clouds, and for dataclasses
    of arrays, numbers and such dataclasses: these become one array per field, by its name, such as ``track.mean``.

    Args:
        model: A value of the type to encode.
        varying: Whether to accept arrays and images of another size than ``model``.

    Raises:
        ValueError: There is no codec for the type of ``model``.
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
    # Drake's images and point clouds are recognized without importing their modules, which a DPS alone may not need.
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
    """Return the codec for arrays of one shape and type.

    Args:
        shape: The shape of every array; others are refused when they are encoded.
        dtype: The type of the entries, to which values are converted.
    """

    def encode(value: Any) -> dict[str, np.ndarray]:
        unconverted = np.asarray(value)
        if unconverted.dtype.kind in "US" and np.dtype(dtype).kind in "fiub":  # numpy would read the texts.
            raise ValueError(f"an array of numbers is expected here, not {value!r}")
        array = np.asarray(unconverted, dtype=dtype)
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
    parts: dict[str, Codec] = {}
    for field in fields(model):
        if not field.init:
            raise ValueError(
                f"there is no codec for a {kind.__name__}: its field {field.name} is no argument of its constructor; "
                "give a Codec"
            )
        parts[field.name] = _part(kind, field.name, getattr(model, field.name))
    # What the constructor makes beside the fields, it makes again.
    attributes = {*parts, *getattr(model, "__dict__", {})}

    def encode(value: Any) -> dict[str, np.ndarray]:
        if type(value) is not kind:
            raise ValueError(f"a {kind.__name__} is expected here, not {value!r}")
        for name in getattr(value, "__dict__", {}).keys() - attributes:
            if not isinstance(getattr_static(kind, name, None), cached_property):
                raise ValueError(f"the attribute {name} of a {kind.__name__} would be lost: make it a field")
        return {
            f"{name}.{part}" if part else name: array
            for name, codec in parts.items()
            for part, array in _encode_part(kind, name, codec, getattr(value, name)).items()
        }

    def decode(arrays: Mapping[str, np.ndarray]) -> Any:
        arrays_by_field: dict[str, dict[str, np.ndarray]] = {name: {} for name in parts}
        for key, array in arrays.items():
            name, _, part = key.partition(".")
            arrays_by_field.setdefault(name, {})[part] = array
        return kind(**{name: codec.decode(arrays_by_field[name]) for name, codec in parts.items()})

    return Codec(encode, decode)


def _encode_part(owner: type, name: str, codec: Codec, value: Any) -> Mapping[str, np.ndarray]:
    try:
        return codec.encode(value)
    except ValueError as error:
        raise ValueError(f"the field {name} of a {owner.__name__}: {error}") from None


def _part(owner: type, name: str, value: Any) -> Codec:
    if isinstance(value, np.ndarray):
        return _any_array_codec()
    if isinstance(value, bool | int | float):
        return _number_field_codec(value)
    if is_dataclass(value) and not isinstance(value, type):
        return _dataclass_codec(value)
    raise ValueError(
        f"there is no codec for a {owner.__name__}: its field {name} is neither an array nor a number, but a "
        f"{type(value).__name__}; give a Codec"
    )


def _number_field_codec(model: bool | int | float) -> Codec:
    """Return the codec for a field whose default is ``model``: other numbers keep their own type (``x: float = 0``)."""
    kind, dtype = type(model), np.asarray(model).dtype

    def encode(value: Any) -> dict[str, np.ndarray]:
        array = np.asarray(value)
        if array.ndim or array.dtype.kind not in "biuf":
            raise ValueError(f"a number of at most 64 bits is expected here, not {value!r}")
        return {"": array}

    def decode(arrays: Mapping[str, np.ndarray]) -> Any:
        array = arrays[""]
        if array.dtype == dtype:
            return kind(array.item())
        return array.item() if array.dtype in _PYTHON_NUMBERS else array[()]

    return Codec(encode, decode)


Arrays = Mapping[str, np.ndarray]

_PYTHON_NUMBERS = (np.dtype(bool), np.dtype(np.int64), np.dtype(float))
"""The types that NumPy gives Python's own numbers."""


class SnapshotError(ValueError):
    """A snapshot cannot be taken or applied."""


class AbstractState:
    """Reads and writes the abstract state of one leaf system.

    The codecs come from the system's attribute ``codecs``, or else from `codec_of` of the present value of the state.

    Args:
        path: The path of the system, for messages.
        system: The leaf system.
        context: Its own Context.

    Raises:
        SnapshotError: The system keeps an abstract value that no codec can carry.
    """

    def __init__(self, path: str, system: System, context: Context) -> None:
        self._path = path
        self._system = system
        self._codecs: dict[int, Codec] = {}
        # Snapshots hold their variables instead.
        if is_plant(system) or is_scene_graph(system) or is_camera(system):
            return
        if context.num_abstract_parameters():
            raise SnapshotError(
                f"{path} ({class_name(system)}) has an abstract parameter, which a snapshot cannot hold: use a system "
                "that keeps it in numeric parameters, or in abstract state with a codec"
            )
        declared: Mapping[int, Codec] = getattr(system, "codecs", {})
        for index in range(context.num_abstract_states()):
            self._codecs[index] = declared.get(index) or self._codec_of(context, index)

    def _codec_of(self, context: Context, index: int) -> Codec:
        try:
            return codec_of(context.get_abstract_state(index).get_value(), varying=True)
        # pydrake raises a RuntimeError for a C++ type without bindings.
        except (ValueError, RuntimeError) as error:
            reason = str(error) if isinstance(error, ValueError) else "Python does not know its type"
            raise SnapshotError(
                f"{self._path} keeps abstract state {index} and declares no codec for it: give the system, a "
                f"{class_name(self._system)}, an attribute codecs = {{{index}: Codec(encode, decode)}}, or use another "
                f"one ({reason})"
            ) from error

    def __bool__(self) -> bool:
        return bool(self._codecs)

    def read(self, context: Context) -> dict[str, np.ndarray]:
        """Return the state in the system's own context as arrays, by ``<index>/<name>``.

        Raises:
            SnapshotError: The codec does not accept the present state.
        """
        arrays: dict[str, np.ndarray] = {}
        for index in self._codecs:
            arrays |= self._encode(index, context.get_abstract_state(index).get_value())
        return arrays

    def _encode(self, index: int, value: object) -> dict[str, np.ndarray]:
        try:
            parts = self._codecs[index].encode(value)
        except (ValueError, TypeError, AttributeError) as error:
            raise SnapshotError(f"abstract state {index} of {self._path}: {error}") from error
        return {f"{index}/{name}": np.asarray(array) for name, array in parts.items()}

    def writer(self, arrays: Arrays) -> Callable[[Context], None]:
        """Return a function that sets the state in the system's own context to arrays of `read`.

        Raises:
            SnapshotError: The arrays do not describe such a state.
        """
        values = {index: self._decode(index, arrays) for index in self._codecs}

        def write(context: Context) -> None:
            for index, value in values.items():
                context.SetAbstractState(index, value)

        return write

    def _decode(self, index: int, arrays: Arrays) -> object:
        prefix = f"{index}/"
        parts = {key.removeprefix(prefix): array for key, array in arrays.items() if key.startswith(prefix)}
        try:
            return self._codecs[index].decode(parts)
        except Exception as error:  # Codec and arrays may come from anywhere.
            raise SnapshotError(
                f"abstract state {index} of {self._path} cannot be made of the arrays {', '.join(parts) or 'none'}: "
                f"{error_text(error)}"
            ) from error


class DelayState(AbstractState):
    """Reads and writes the state of a DiscreteTimeDelay of abstract values.

    Drake keeps it in a ring buffer, whose beginning Python cannot read. So the delayed values are read at the output of
    a copy, oldest first, which is stepped; and they are set by filling another copy through its input.
    """

    def __init__(self, path: str, system: DiscreteTimeDelay, context: Context) -> None:
        self._path = path
        self._system = system
        # The last abstract state is the beginning of the ring.
        self._codecs = dict.fromkeys(range(context.num_abstract_states() - 1), self._codec_of(context, 0))

    def read(self, context: Context) -> dict[str, np.ndarray]:
        """Return the delayed values as arrays, by ``<index>/<name>``; the oldest has the index 0."""
        context_copy = self._system.CreateDefaultContext()
        context_copy.SetStateAndParametersFrom(context)
        self._feed(context_copy, context_copy.get_abstract_state(0).get_value())
        arrays: dict[str, np.ndarray] = {}
        for index in self._codecs:
            parts = self._encode(index, self._system.get_output_port().Eval(context_copy))
            # The next step overwrites the array.
            arrays |= {name: np.array(array) for name, array in parts.items()}
            self._step(context_copy)
        return arrays

    def writer(self, arrays: Arrays) -> Callable[[Context], None]:
        context_copy = self._system.CreateDefaultContext()
        for index in self._codecs:
            self._feed(context_copy, self._decode(index, arrays))
            self._step(context_copy)
        return lambda context: context.SetStateAndParametersFrom(context_copy)

    def _feed(self, context_copy: Context, value: object) -> None:
        port = self._system.get_input_port()
        wrapped = port.Allocate()
        wrapped.set_value(value)
        port.FixValue(context_copy, wrapped)

    def _step(self, context_copy: Context) -> None:
        context_copy.SetTime(0.0)  # The first time at which the input is sampled.
        Simulator(self._system, context_copy).AdvancePendingEvents()


def abstract_state(path: str, system: System, context: Context) -> AbstractState:
    """Return the reader and writer of the abstract state of the leaf system at ``path``.

    Args:
        path: Dotted path of the system, for error messages.
        system: The leaf system.
        context: A context of the system; its present abstract values choose the codecs that the system does not
            declare.

    Raises:
        SnapshotError: The system keeps an abstract value that no codec can carry.
    """
    if isinstance(system, DiscreteTimeDelay) and context.num_abstract_states():
        return DelayState(path, system, context)
    return AbstractState(path, system, context)
