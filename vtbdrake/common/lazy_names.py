"""The public names of a package, imported when they are first used."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from lazy_loader import attach_stub

from vtbdrake.common.suggestions import did_you_mean


def attach_names(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package whose ``__init__.pyi`` lists its public names.

    Args:
        package: The ``__name__`` of the package.
        file: The ``__file__`` of the package.

    Raises:
        AttributeError: Raised by ``__getattr__`` for a name that the package does not have, with similar names.
    """
    import_name, list_names, names = attach_stub(package, file)

    def get_public_name(name: str) -> Any:
        if name not in names:
            # With `name`, Python does not add its own suggestion behind this one.
            raise AttributeError(f"module {package!r} has no attribute {name!r}{did_you_mean(name, names)}", name=name)
        return import_name(name)

    return get_public_name, list_names, names
