"""s = [x, a]: every element of a Context by address, unit and bounds; snapshots of it."""

from importlib.metadata import version

from vtbdrake.common.drake_version import warn_if_untested
from vtbdrake.state.archive import ArchiveError
from vtbdrake.state.codecs import SnapshotError
from vtbdrake.state.declarations import (
    AddressedSystem,
    Codec,
    Element,
    NamedVector,
    Quantity,
)
from vtbdrake.state.snapshot import Snapshot
from vtbdrake.state.systems import collect
from vtbdrake.state.variables import AddressError, Variable, VariableError, Variables

__all__ = [
    "AddressError",
    "AddressedSystem",
    "ArchiveError",
    "Codec",
    "Element",
    "NamedVector",
    "Quantity",
    "Snapshot",
    "SnapshotError",
    "Variable",
    "VariableError",
    "Variables",
    "collect",
]

warn_if_untested(version("drake"))
