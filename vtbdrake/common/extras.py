"""Modules that an extra of the package installs."""

from importlib import import_module
from typing import Any


def extra_module(name: str, *, purpose: str, extra: str) -> Any:
    """Return a module that an extra of vtbdrake installs.

    Args:
        name: Full name of the module, such as ``embreex.rtcore``.
        purpose: What needs the module, as the subject of the error message.
        extra: The extra of vtbdrake that installs it.

    Raises:
        ModuleNotFoundError: It is not installed; the error names what needs it, and the extra.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        package = name.partition(".")[0]
        raise ModuleNotFoundError(f"{purpose} needs {package}: pip install 'vtbdrake[{extra}]'") from error
