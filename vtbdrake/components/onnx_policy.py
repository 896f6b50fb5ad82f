"""A trained policy in an ONNX file as a part of a DPS."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Iterable, Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, DiscreteValues, InputPort

from vtbdrake.common.argument_checks import as_array, as_number, as_whole
from vtbdrake.common.extras import extra_module
from vtbdrake.common.failures import one_line
from vtbdrake.components.casadi_system.handler import gather, handler
from vtbdrake.components.tensors import gather_tensors, scatter_tensors
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.state.declarations import weakly

# Bytes: the longest vectors of processors.
_ALIGNMENT = 64
_TYPES = {"tensor(float)": np.float32, "tensor(double)": np.float64}


class OnnxPolicy(AddressedSystem):
    """A policy in an ONNX file, such as a network that was trained in simulation, evaluated by onnxruntime.

    .. pydrake_system::

        name: OnnxPolicy
        input_ports:
        - <every port in inputs>
        output_ports:
        - <every port in outputs>

    At t = 0, T, 2 T, ... the policy is evaluated on the input ports, and its results become the output ports, which are
    state, until the next time. So is the memory of a recurrent policy: a fork and a replay continue it, bit for bit. It
    is a variable by address, named by its input in the file, where characters other than letters and digits are "_".

    The same inputs give the same bits: one thread computes, on the CPU. A result that is not finite is an error, which
    leaves the state as it was, so that the guards of a loop let the fallback command.

    Args:
        path: The ONNX file.
        period: Sample period T in seconds.
        inputs: Input of the file -> the ports that it is made of, one after the other, with their sizes:
            ``{"obs": {"joint_position": 7, "joint_velocity": 7}}``.
        outputs: Output of the file -> the ports that it is cut into, as for the inputs. Outputs of the file that are
            not named are not computed.
        memory: Input of the file -> the output that is its next value, for a recurrent policy. It begins with zeros.
        initial: The values of output ports before the first evaluation, shape (size,) or a scalar; by default zeros.
        units: Units of output ports; "1" if left out.

    Raises:
        FileNotFoundError: There is no such file.
        ModuleNotFoundError: onnxruntime is not installed, which the extra ``onnx`` installs.
        ValueError: The file is no policy that can be evaluated, or has other names, shapes or types: all are numbers of
            32 or 64 bits, with a shape that is fixed, or fixed but for the batch (the first axis of an input), which
            is 1 here.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        period: float,
        inputs: Mapping[str, Mapping[str, int]],
        outputs: Mapping[str, Mapping[str, int]],
        memory: Mapping[str, str] | None = None,
        initial: Mapping[str, ArrayLike] | None = None,
        units: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__()
        memory, initial, units = memory or {}, initial or {}, units or {}
        if not 0.0 < as_number("OnnxPolicy: period", period) < inf:
            raise ValueError(f"OnnxPolicy: period is positive and finite, in s, not {period}")
        sizes_in, sizes_out = _ports("inputs", inputs), _ports("outputs", outputs)
        for name, values in {"initial": initial, "units": units}.items():
            if unknown := values.keys() - sizes_out.keys():
                raise ValueError(
                    f"OnnxPolicy: {name} names {_listed(unknown)}, but the output ports are {_listed(sizes_out)}"
                )
        network = _Network(Path(path), inputs, outputs, memory)
        ports = [self.DeclareVectorInputPort(port, size) for port, size in sizes_in.items()]
        states = []
        for port, size in sizes_out.items():
            value = _initial(port, size, initial.get(port, 0.0))
            value = value if size > 1 else value.item()
            group = self.declare_discrete_state(**{port: Quantity(value, units.get(port, "1"))})
            self.DeclareStateOutputPort(port, group.index)
            states.append(int(group.index))
        for name, shape in network.memory_shapes.items():
            group = self.declare_discrete_state(**{re.sub(r"\W", "_", name): Quantity(np.zeros(shape))})
            states.append(int(group.index))
        update = handler(
            states=tuple(states),
            updates=True,
            clock=False,
            parameters=None,
            inputs=tuple(weakly(port, InputPort.Eval) for port in ports),
            state_value=DiscreteValues.get_mutable_value,
            vector_value=BasicVector.value,
            compute=network.evaluate,
            deliver=None,
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, update)


class _Network:
    """An ONNX file, checked against what it is to take and to return.

    Args:
        path, inputs, outputs, memory: See `OnnxPolicy`.

    Attributes:
        memory_shapes: The shape of each memory, by its input of the file.
    """

    def __init__(
        self,
        path: Path,
        inputs: Mapping[str, Mapping[str, int]],
        outputs: Mapping[str, Mapping[str, int]],
        memory: Mapping[str, str],
    ) -> None:
        self._name = path.name
        self.session = _session(path)
        self.inputs, self.outputs, self.memory = inputs, outputs, memory
        tensors = {tensor.name: tensor for tensor in self.session.get_inputs()}
        self._check_names("input", "inputs", (*inputs, *memory), tensors)
        made = [tensor.name for tensor in self.session.get_outputs()]
        self._check_names("output", "outputs", (*outputs, *memory.values()), made)
        if unfed := tensors.keys() - {*inputs, *memory}:
            raise ValueError(
                f"{self._name} has the input {_listed(unfed)} beside {_listed((*inputs, *memory))}: name its ports in "
                "inputs, or in memory the output that is its next value"
            )
        batch = {length for name in inputs for length in tensors[name].shape[:1] if isinstance(length, str)}
        self.zeros: dict[str, np.ndarray] = {
            name: np.zeros(self._shape(t, batch), self._dtype(t)) for name, t in tensors.items()
        }
        for name, ports in inputs.items():
            self._check_size("input", name, self.zeros[name], ports)
        self.results = self._tried(made)
        for name, ports in outputs.items():
            self._check_size("output", name, self.results[name], ports)
        for name, following in memory.items():
            before, after = self.zeros[name], self.results[following]
            if (before.shape, before.dtype) != (after.shape, after.dtype):
                raise ValueError(
                    f"the memory {name!r} of {self._name} is {before.dtype} of shape {before.shape}, but {following!r} "
                    f"is {after.dtype} of shape {after.shape}: name the output that is its next value"
                )
        self.memory_shapes = {name: self.zeros[name].shape for name in memory}
        self._by_thread = threading.local()
        # Made now, since it takes longer than a cycle of a loop.
        self._by_thread.buffers = _Buffers(self)

    def evaluate(self, blocks: Sequence[ArrayLike]) -> np.ndarray:
        """Return the entries of the next outputs and memory, for the present outputs, memory and inputs."""
        try:
            buffers = self._by_thread.buffers
        except AttributeError:
            buffers = self._by_thread.buffers = _Buffers(self)
        gather(blocks, buffers.z)
        if not buffers.evaluate():
            raise ValueError(f"OnnxPolicy: {self._name} results in {buffers.y.tolist()}, which is not finite")
        return buffers.y

    def _check_names(self, kind: str, argument: str, names: Iterable[str], there: Iterable[str]) -> None:
        if twice := {name for name in names if list(names).count(name) > 1}:
            raise ValueError(f"OnnxPolicy: the {kind} {_listed(twice)} of {self._name} is named twice")
        if missing := set(names) - set(there):
            raise ValueError(
                f"{self._name} has no {kind} {_listed(missing)}, but {_listed(there)}: name these in {argument} and "
                "memory, or export the policy with other names"
            )

    def _dtype(self, tensor: Any) -> type:
        if tensor.type not in _TYPES:
            raise ValueError(
                f"{tensor.name!r} of {self._name} is a {tensor.type}, not a tensor(float) or a tensor(double): export "
                "the policy with numbers of 32 or 64 bits"
            )
        return _TYPES[tensor.type]

    def _shape(self, tensor: Any, batch: set[str]) -> tuple[int, ...]:
        """Return the shape of an input with a batch of 1."""
        shape = []
        for axis, length in enumerate(tensor.shape):
            is_batch = length in batch if isinstance(length, str) else length is None and axis == 0
            if not (is_batch or isinstance(length, int)):
                raise ValueError(
                    f"{tensor.name!r} of {self._name} has the shape {tuple(tensor.shape)}, where more than the batch "
                    "is open: export the policy with a fixed shape (in torch.onnx.export, leave these axes out of the "
                    "dynamic ones)"
                )
            shape.append(1 if is_batch else length)
        return tuple(shape)

    def _check_size(self, kind: str, name: str, tensor: np.ndarray, ports: Mapping[str, int]) -> None:
        if sum(ports.values()) != tensor.size:
            sizes = ", ".join(f"{port} ({size})" for port, size in ports.items())
            raise ValueError(
                f"the {kind} {name!r} of {self._name} has {tensor.size} entries, in the shape {tensor.shape}, but its "
                f"ports {sizes} have {sum(ports.values())}: give the ports and sizes with which it was trained"
            )

    def _tried(self, made: list[str]) -> dict[str, np.ndarray]:
        """Return the results for zeros, whose shapes need not be in the file, of all outputs that are named."""
        named = [name for name in made if name in (*self.outputs, *self.memory.values())]
        for tensor in self.session.get_outputs():
            if tensor.name in named:
                self._dtype(tensor)
        try:
            return dict(zip(named, self.session.run(named, self.zeros), strict=True))
        except Exception as error:
            raise ValueError(f"{self._name} cannot be evaluated at zeros: {one_line(error)}") from error


class _Buffers:
    """The arrays on which one thread evaluates a network, read and written in place.

    Attributes:
        z: The entries of the present outputs, the memory and the inputs.
        y: The entries of the next outputs and memory.
    """

    def __init__(self, network: _Network) -> None:
        onnxruntime = _onnxruntime()
        session, binding = network.session, network.session.io_binding()
        fed = {name: _aligned(network.zeros[name]) for name in (*network.memory, *network.inputs)}
        made = {name: _aligned(network.results[name]) for name in (*network.outputs, *network.memory.values())}
        # An OrtValue of an array on the CPU shares its numbers.
        for name, array in fed.items():
            binding.bind_ortvalue_input(name, onnxruntime.OrtValue.ortvalue_from_numpy(array))
        for name, array in made.items():
            binding.bind_ortvalue_output(name, onnxruntime.OrtValue.ortvalue_from_numpy(array))
        shown = sum(made[name].size for name in network.outputs)
        self.z = np.zeros(shown + sum(array.size for array in fed.values()))
        self.y = np.zeros(sum(array.size for array in made.values()))
        self._tensors, self._made, self._entries = list(fed.values()), list(made.values()), self.z[shown:]
        self._run, self._binding = session.run_with_iobinding, binding

    def evaluate(self) -> bool:
        """Compute y of z; return whether all of it is finite."""
        scatter_tensors(self._entries, self._tensors)
        self._run(self._binding)
        return gather_tensors(self._made, self.y)


def _aligned(like: np.ndarray) -> np.ndarray:
    """Return zeros of the shape and type of an array, at an address on which the order of sums does not depend."""
    padded = np.zeros(like.nbytes + _ALIGNMENT, dtype=np.uint8)
    start = -padded.ctypes.data % _ALIGNMENT
    return padded[start : start + like.nbytes].view(like.dtype).reshape(like.shape)


def _onnxruntime() -> Any:
    return extra_module("onnxruntime", purpose="OnnxPolicy", extra="onnx")


def _session(path: Path) -> Any:
    onnxruntime = _onnxruntime()
    if not path.is_file():
        raise FileNotFoundError(f"there is no ONNX file {path}: export the policy to it, or correct the path")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    options.log_severity_level = 4  # What is wrong is raised.
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # Its classes have no common base but this one.
        raise ValueError(
            f"{path} is no policy that onnxruntime {onnxruntime.__version__} can load: {one_line(error)}; export it "
            "again, for an older opset if it names one"
        ) from error


def _ports(argument: str, tensors: Mapping[str, Mapping[str, int]]) -> dict[str, int]:
    """Return the sizes of all ports by name."""
    if not isinstance(tensors, Mapping) or not tensors or not all(isinstance(p, Mapping) for p in tensors.values()):
        form = '{"name in the file": {"port": size, ...}, ...}'
        raise ValueError(f"OnnxPolicy: {argument} must be {form}, not {tensors!r}")
    sizes: dict[str, int] = {}
    for ports in tensors.values():
        for port, size in ports.items():
            if as_whole(f"OnnxPolicy: the size of {port}", size) < 1 or port in sizes:
                raise ValueError(f"OnnxPolicy: a port is given once, with a size of at least 1, unlike {port}: {size}")
            sizes[port] = int(size)
    return sizes


def _initial(port: str, size: int, value: ArrayLike) -> np.ndarray:
    array = as_array(f"OnnxPolicy: initial of {port}", value)
    if array.shape not in ((), (size,)) or not np.isfinite(array).all():
        raise ValueError(f"OnnxPolicy: initial of {port} is one finite number, or {size} of them, not {value!r}")
    return np.array(np.broadcast_to(array, (size,)))


def _listed(names: Iterable[str]) -> str:
    return ", ".join(map(repr, names))
