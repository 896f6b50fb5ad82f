"""Packages that import their public names when these are first used, and modules of extras."""

import ast
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any


def lazy_names(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package.

    Its stub ``__init__.pyi`` lists the names, also for editors and type checkers: it contains nothing but imports
    such as ``from vtbdrake.control.runtime import Runtime as Runtime``.

    Args:
        package: The ``__name__`` of the package.
        file: The ``__file__`` of the package.
    """
    stub = ast.parse(Path(file).with_name("__init__.pyi").read_text("utf-8"))
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    homes = {alias.name: str(node.module) for node in imports for alias in node.names}

    def getattr_(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(homes[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    def dir_() -> list[str]:
        return sorted({*vars(sys.modules[package]), *homes})

    return getattr_, dir_, sorted(homes)


def extra_module(name: str, *, purpose: str, extra: str) -> Any:
    """Return a module that an extra of vtbdrake installs.

    Raises:
        ModuleNotFoundError: It is not installed; the error names what needs it, and the extra.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        package = name.partition(".")[0]
        raise ModuleNotFoundError(f"{purpose} needs {package}: pip install 'vtbdrake[{extra}]'") from error
