"""Digests of values, functions and classes, by which a study notices that one of them has changed."""

from __future__ import annotations

import copyreg
import dis
import functools
import hashlib
import importlib.util
import re
import sys
import weakref
from collections.abc import Iterator
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES, SourceFileLoader
from pathlib import Path
from types import (
    CellType,
    CodeType,
    FunctionType,
    GetSetDescriptorType,
    MappingProxyType,
    MemberDescriptorType,
    MethodType,
    ModuleType,
)
from typing import Any, NamedTuple, cast

import numpy as np
from pydrake.common.cpp_template import TemplateBase

_LEAVES = (bool, int, float, complex, str, bytes, type(None), type(...), type(NotImplemented))


def _hashed(*parts: bytes) -> bytes:
    state = hashlib.blake2b(digest_size=16)
    for part in parts:
        state.update(len(part).to_bytes(8, "little") + part)
    return state.digest()


# What Python adds to a class, or what belongs to its instances.
_SLOTS = (GetSetDescriptorType, MemberDescriptorType)

# The types of the wrappers that functools makes around functions.
_CACHED = type(functools.cache(_hashed))
_DISPATCHING = cast(FunctionType, functools.singledispatch(_hashed)).__code__

# How the parts of a node are compared: in their order, as a set, or as a set of pairs.
_ORDERED = 0
_SET = 1
_PAIRS = 2

# The module in an import of Cython.
_CYTHON_IMPORT = re.compile(rb"^\s*(?:from|c?import)\s+([\w.]+)", re.MULTILINE)


class _Node(NamedTuple):
    """A value without what it refers to, and its parts: the label of a plain value, or the number of another node."""

    head: bytes
    parts: list[bytes | int]
    kind: int


def digest(value: Any) -> tuple[str, tuple[str, ...]]:
    """Return a digest of a value, and the types of the objects in it whose state cannot be read.

    Equal digests mean the same code and the same values, in any process that runs the same version of Python. The
    digest covers everything that the value refers to: containers; objects, by the state with which pickle would send
    them, and the class if it is the user's; functions, by their bytecode (without line numbers, docstrings and names
    of local variables), default values, closure, and by the globals and the attributes of the user's modules that they
    use. What the user has compiled from Cython is given by its name and the source of its module. Python, vtbdrake and
    installed packages are given by their names, and the values that they hold for the user (a partial, a cache around a
    function) by their parts. Sets and dicts have no order.

    The references form a graph, possibly with cycles. Its nodes get labels that are refined by the labels of their
    parts until no more nodes can be told apart (Weisfeiler and Leman, 1968), so that neither the order in which the
    graph is walked nor sharing matters.
    """
    graph = _Graph(value)
    return graph.digest(), tuple(sorted(graph.unreadable))


def attributes(value: Any) -> dict[str, Any]:
    """Return the attributes of an object in Python, without those by which pydrake keeps other objects alive."""
    values_by_name = getattr(value, "__dict__", {})
    return {name: part for name, part in values_by_name.items() if not name.startswith("_pydrake_internal")}


def is_own(thing: Any) -> bool:
    """Return whether a module, class or function is the user's: not of Python, of this package, or installed."""
    return _is_own_module(_home(thing))


class _Graph:
    def __init__(self, root: Any) -> None:
        self.unreadable: set[str] = set()
        self._numbers: dict[int, int] = {}
        # They are kept, so that no other object gets the id of one of them.
        self._values: list[Any] = []
        self._nodes: list[_Node] = []
        self._part((root,))
        for value in self._values:  # It grows meanwhile.
            self._nodes.append(self._node(value))

    def digest(self) -> str:
        labels, count = [_hashed(node.head) for node in self._nodes], 0
        while len(set(labels)) > count:
            count = len(set(labels))
            labels = [self._refined(node, label, labels) for node, label in zip(self._nodes, labels, strict=True)]
        return _hashed(labels[0], *sorted(set(labels))).hex()

    @staticmethod
    def _refined(node: _Node, label: bytes, labels: list[bytes]) -> bytes:
        parts = [part if isinstance(part, bytes) else labels[part] for part in node.parts]
        if node.kind == _SET:
            parts.sort()
        elif node.kind == _PAIRS:
            parts = [part for pair in sorted(zip(parts[::2], parts[1::2], strict=True)) for part in pair]
        return _hashed(label, *parts)

    def _part(self, value: Any) -> bytes | int:
        if isinstance(value, np.generic) and type(value.item()) in _LEAVES:
            value = value.item()
        if type(value) in _LEAVES:
            return _hashed(_text(value))
        number = self._numbers.setdefault(id(value), len(self._values))
        if number == len(self._values):
            self._values.append(value)
        return number

    def _made(self, head: str, *parts: Any, kind: int = _ORDERED) -> _Node:
        return _Node(head.encode(errors="surrogatepass"), [self._part(part) for part in parts], kind)

    def _node(self, value: Any) -> _Node:
        if type(value) is np.ndarray and not value.dtype.hasobject and value.dtype.names is None:
            return self._made("array", value.dtype.str, value.shape, np.ascontiguousarray(value).tobytes())
        match value:
            case tuple() | list() if type(value) in (tuple, list):
                return self._made(type(value).__name__, *value)
            case set() | frozenset() if type(value) in (set, frozenset):
                return self._made("set", *value, kind=_SET)
            case dict() | MappingProxyType() if type(value) in (dict, MappingProxyType):
                return self._made("dict", *(part for pair in value.items() for part in pair), kind=_PAIRS)
            case ModuleType():
                return self._made(f"module {value.__name__}")
            case CodeType():
                return self._code(value)
            case FunctionType():
                return self._function(value)
            case MethodType():
                return self._made("method", value.__func__, value.__self__)
            case type():
                return self._class(value)
            case staticmethod() | classmethod():
                return self._made(type(value).__name__, value.__func__)
            case property():
                return self._made("property", value.fget, value.fset, value.fdel)
            case functools.cached_property():
                return self._made("cached property", value.func)
            case CellType():
                return self._made("cell", _content(value))
            case weakref.WeakKeyDictionary() | weakref.WeakValueDictionary() | weakref.WeakSet():
                return self._made("memory")  # It holds nothing by itself: it is a cache, or a list of instances.
            case _Source():
                return self._source(value)
            case _ if isinstance(value, _CACHED):
                return self._made("cached", value.__wrapped__, value.cache_parameters())
            case TemplateBase():
                return self._made(f"template {value.name}")  # It grows as modules of Drake are imported.
            case np.vectorize():
                # Its state also holds a cache.
                return self._made("vectorize", value.pyfunc, value.otypes, value.signature, value.excluded)
            case _:
                return self._object(value)

    def _code(self, code: CodeType) -> _Node:
        names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
        shape = (code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags, names)
        links = (code.co_names, code.co_freevars, code.co_exceptiontable)
        return self._made("code", code.co_code, shape, links, code.co_consts)

    def _source(self, module: _Source) -> _Node:
        if module.is_compiled:
            text, names = module.compiled_from()
            return self._made("compiled source", text, [_source(name) for name in names])
        code = module.code()
        return self._made("source", code, [_source(name) for name in _References(code).imports(module.package)])

    def _function(self, function: FunctionType) -> _Node:
        if function.__code__ is _DISPATCHING:  # What else it holds is a cache.
            return self._made("dispatch", function.registry)  # type: ignore[attr-defined]
        home, name = _home(function), function.__qualname__
        if not _is_own_module(home) and _found(home, name) is function:
            return self._made(f"function {home}.{name}")
        code: Any = function.__code__
        names = code.co_freevars
        closure = dict(zip(names, map(_content, function.__closure__ or ()), strict=True))
        values = (function.__defaults__, function.__kwdefaults__, closure, vars(function))
        if not _is_own_module(home):
            return self._made(f"function {home}.{code.co_qualname}", *values)
        if function.__doc__ is not None and code.co_consts and code.co_consts[0] == function.__doc__:
            code = code.replace(co_consts=(None, *code.co_consts[1:]))
        return self._made("function", code, *values, _used(function))

    def _class(self, kind: type) -> _Node:
        if not is_own(kind):
            return self._made(f"class {kind.__module__}.{kind.__qualname__}")
        if _source(_home(kind)).is_compiled:
            return self._made(f"class {kind.__name__}", kind.__bases__, _source(_home(kind)))
        declared = vars(kind).get("__dataclass_fields__", {})
        fields = {name: (item.default, item.default_factory) for name, item in declared.items()}
        return self._made(f"class {kind.__name__}", kind.__bases__, dict(_members(kind)), fields)

    def _object(self, value: Any) -> _Node:
        kind = type(value)
        home, name = (getattr(value, key, None) for key in ("__module__", "__qualname__"))
        if isinstance(home, str) and isinstance(name, str) and _found(home, name) is value:
            if not _is_own_module(home):
                return self._made(f"global {home}.{name}")  # For example a function of a compiled library.
            if _source(home).is_compiled:
                return self._made(f"compiled {name}", _source(home))
        reduced = _reduced(value)
        if reduced is None:
            self.unreadable.add(f"{kind.__module__}.{kind.__qualname__}")
            return self._made("object", kind, attributes(value) if is_own(kind) else None)
        make, arguments, state, items, pairs = (*reduced[:5], None, None, None)[:5]
        if isinstance(state, dict):
            state = {name: part for name, part in state.items() if not _is_cached(kind, name)} or None
        elements = [list(more) if more is not None else None for more in (items, pairs)]
        return self._made("object", kind, make, arguments, state, *elements)


def _text(value: Any) -> bytes:
    # The decimal text of a very large integer is refused by Python.
    text = hex(value) if type(value) is int else repr(value)
    return f"{type(value).__name__} {text}".encode(errors="surrogatepass")


def _reduced(value: Any) -> tuple[Any, ...] | None:
    """Return the content that pickle would send of an object; None if it cannot, or would only look up its name."""
    registered = copyreg.dispatch_table.get(type(value))
    try:
        reduced = value.__reduce_ex__(4) if registered is None else registered(value)
    except Exception:  # Anything may happen in it: an object that cannot be pickled is no error here.
        return None
    return reduced if isinstance(reduced, tuple) else None


def _home(thing: Any) -> str:
    """Return the name of the module in which a class or a function was written."""
    if isinstance(thing, ModuleType):
        return thing.__name__
    if isinstance(thing, FunctionType):  # functools.wraps changes __module__.
        return str(thing.__globals__.get("__name__", ""))
    return str(thing.__module__)


@cache
def _is_own_module(name: str) -> bool:
    if name == "__main__":  # A notebook, a script, or a program that runs one.
        return True
    package = name.partition(".")[0]
    if package in (*sys.stdlib_module_names, "vtbdrake", "pybind11_builtins", "nanobind"):
        return False
    # A module in a compiled library has no file, but the package in which it lies.
    files = [file for file in map(_file, (name, package)) if file is not None]
    return not files or not {"site-packages", "dist-packages"} & set(Path(files[0]).parts)


def _file(name: str) -> str | None:
    """Return the file of a module, which need not be imported; None if it has none."""
    if name in sys.modules:
        return getattr(sys.modules[name], "__file__", None)
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return None
    return None if spec is None else spec.origin


def _found(home: str, qualname: str) -> Any:
    value: Any = sys.modules.get(home)
    for name in qualname.split("."):
        value = getattr(value, name, None)
    return value


def _content(cell: CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # It is not filled yet.
        return None


class _References:
    """The names to which the code of a function refers, including the functions, classes and comprehensions in it.

    Attributes:
        globals: Names of global variables.
        attributes: Names of attributes, among others.
    """

    def __init__(self, code: CodeType) -> None:
        self.globals: set[str] = set()
        self.attributes: set[str] = set()
        # (level, module, names in it) of every import.
        self._imports: set[tuple[int, str, tuple[str, ...]]] = set()
        self._add(code)

    def _add(self, code: CodeType) -> None:
        self.attributes.update(code.co_names)
        values: list[Any] = []
        for instruction in dis.get_instructions(code):
            if instruction.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
                self.globals.add(instruction.argval)
            elif instruction.opname == "IMPORT_NAME":
                level, names = values[-2:]
                self._imports.add((level, instruction.argval, tuple(names or ())))
            if instruction.opname != "EXTENDED_ARG":
                values.append(instruction.argval)
        for constant in code.co_consts:
            if isinstance(constant, CodeType):
                self._add(constant)

    def imports(self, package: str) -> list[str]:
        """Return the names of the user's modules that are imported in a package."""
        modules = []
        for level, module, names in self._imports:
            base = "." * level + module
            candidates = [base, *(base + ("" if base.endswith(".") else ".") + name for name in names)]
            modules += [name for name in (_resolved(candidate, package) for candidate in candidates) if name]
        return sorted(set(modules))


def _used(function: FunctionType) -> dict[str, Any]:
    """Return the globals that a function uses, and what it uses of the user's modules, by name."""
    references, scope = _References(function.__code__), function.__globals__
    used = {
        name: _narrowed(scope[name], references.attributes, frozenset()) for name in references.globals if name in scope
    }
    # They may not be imported yet. Importing them here could have effects, so that their source counts, unlike below.
    imported = references.imports(str(scope.get("__package__") or ""))
    return used | {f"import {name}": _source(name) for name in imported}


def _narrowed(value: Any, names: set[str], inside: frozenset[str]) -> Any:
    """Return the used part of a module of the user: the attributes that have one of the names."""
    if not isinstance(value, ModuleType) or not is_own(value) or value.__name__ in inside:
        return value
    inside |= {value.__name__}
    return {name: _narrowed(vars(value)[name], names, inside) for name in names if name in vars(value)}


def _resolved(name: str, package: str) -> str:
    """Return the full name of a module of the user; empty if it is none, or cannot be found."""
    try:
        full = importlib.util.resolve_name(name, package)
        # Finding a module imports the packages in which it lies.
        is_own_file = _is_own_module(full.partition(".")[0]) and _is_own_module(full)
        return full if is_own_file and importlib.util.find_spec(full) is not None else ""
    except (ImportError, ValueError, AttributeError):
        return ""


class _Source(NamedTuple):
    """A module of the user, by its source."""

    name: str

    @property
    def is_compiled(self) -> bool:
        """Return whether it is a shared library, for example of a module in Cython."""
        return (_file(self.name) or "").endswith(tuple(EXTENSION_SUFFIXES))

    def compiled_from(self) -> tuple[bytes, list[str]]:
        """Return the source in Cython beside the shared library, and the user's modules that it imports.

        Without a source it is the library itself, which another compiler makes another one of.
        """
        library = Path(_file(self.name) or "")
        name = library.name.partition(".")[0]
        files = [file for file in (library.with_name(name + end) for end in (".pyx", ".pxd")) if file.is_file()]
        text = b"\n".join(file.read_bytes() for file in files or [library])
        imported = {name.decode() for name in _CYTHON_IMPORT.findall(text)} if files else set()
        return text, sorted({module for name in imported if (module := _resolved(name, self.package))})

    @property
    def package(self) -> str:
        spec = importlib.util.find_spec(self.name)
        return "" if spec is None else str(spec.parent)

    def code(self) -> CodeType:
        """Return the compiled module, without running it; an empty one if it has no source."""
        file = _file(self.name) or ""
        code = SourceFileLoader(self.name, file).get_code(self.name) if file.endswith(".py") else None
        return code or compile("", self.name, "exec")


@cache
def _source(name: str) -> _Source:
    return _Source(name)  # One object for each, so that modules that import each other are a finite graph.


def _members(kind: type) -> Iterator[tuple[str, Any]]:
    """Yield what the body of a class defines, without what Python or a dataclass has generated."""
    for name, member in vars(kind).items():
        function = member.__func__ if isinstance(member, staticmethod | classmethod) else member
        generated = isinstance(function, FunctionType) and function.__code__.co_filename == "<string>"
        hidden = name.startswith("__") and name.endswith("__") and not isinstance(function, FunctionType)
        if not (generated or hidden or name == "_abc_impl" or isinstance(member, _SLOTS)):
            yield name, member


def _is_cached(kind: type, name: str) -> bool:
    """Return whether an attribute is only the memory of a property."""
    return any(isinstance(vars(base).get(name), functools.cached_property) for base in kind.__mro__)
