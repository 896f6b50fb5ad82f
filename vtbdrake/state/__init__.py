"""s = [x, a]: every element of a Context by address, unit and bounds; snapshots of it."""

from vtbdrake.state.archive import ArchiveError
from vtbdrake.state.codecs import SnapshotError
from vtbdrake.state.declarations import NO_DICT, Codec, Element, continuous_state, discrete_state, parameter, weakly
from vtbdrake.state.snapshot import Snapshot
from vtbdrake.state.systems import collect
from vtbdrake.state.variables import AddressError, Variable, VariableError, Variables

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
