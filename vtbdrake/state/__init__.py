"""s = [x, a]: every element of a Context by address, unit and bounds; snapshots of it."""

from vtbdrake.state.abstract_state import SnapshotError
from vtbdrake.state.archive import ArchiveError
from vtbdrake.state.collect import collect
from vtbdrake.state.collectable import NO_DICT, weakly
from vtbdrake.state.element import Codec, Element, continuous_state, discrete_state, parameter
from vtbdrake.state.snapshot import Snapshot
from vtbdrake.state.variable import Variable, VariableError
from vtbdrake.state.variables import AddressError, Variables

__all__ = [
    "NO_DICT",
    "AddressError",
    "ArchiveError",
    "Codec",
    "Element",
    "Snapshot",
    "SnapshotError",
    "Variable",
    "VariableError",
    "Variables",
    "collect",
    "continuous_state",
    "discrete_state",
    "parameter",
    "weakly",
]
