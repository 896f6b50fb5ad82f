"""Snapshots: s(t) as named arrays, saved, compared and applied; and copies from Context to Context."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from html import escape
from types import MappingProxyType
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, Diagram, System

from vtbdrake.common.argument_checks import check_plain
from vtbdrake.state.archive import archive_bytes, read_archive, write_archive
from vtbdrake.state.codecs import SnapshotError, abstract_state
from vtbdrake.state.systems import is_plant, leaves, read_group, stateful_leaves, write_group
from vtbdrake.state.variables import VariableError, Variables, html_table

KIND = "vtbdrake snapshot"
VERSION = 1


@dataclass(frozen=True, eq=False, repr=False)
class Snapshot:
    """The state s(t) = [x, a] of a whole Diagram at one time.

    Attributes:
        time: Time t in seconds.
        scenario: Plain data that identifies the scenario; empty for a bare Diagram.
        values: The addressed variables (derived ones left out), by address.
        groups: Every numeric group and, through its codec, every abstract state of every leaf system, under
            ``path/group/index`` and ``path/abstract/index/name``.
        notes: Plain data, as JSON has it, that is no part of the state, such as the ``camera.position`` of the page
            that has saved it.

    Two snapshots are equal if all attributes but the notes are, where NaN equals NaN. Arrays are read only. The contact
    results of a discrete plant's last step are not part of a snapshot: Python cannot read them.
    """

    time: float
    values: Mapping[str, np.ndarray]
    groups: Mapping[str, np.ndarray]
    scenario: Mapping[str, Any] = field(default_factory=dict)
    notes: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("values", "groups"):
            arrays = {key: np.array(value) for key, value in getattr(self, name).items()}
            for array in arrays.values():
                array.flags.writeable = False
            object.__setattr__(self, name, MappingProxyType(arrays))

    def __reduce__(self) -> tuple[Any, ...]:
        return Snapshot, (self.time, dict(self.values), dict(self.groups), dict(self.scenario), dict(self.notes))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Snapshot):
            return NotImplemented
        return self.scenario == other.scenario and not self.compare(other)

    # Arrays have no hash.
    __hash__ = None  # type: ignore[assignment]

    def __getitem__(self, address: str) -> np.ndarray:
        """Return the value of an addressed variable."""
        return self.values[address]

    def __repr__(self) -> str:
        owner = self.scenario.get("scenario", "a bare Diagram").partition(":")[2] or "a bare Diagram"
        return f"Snapshot(t={self.time:g} s, {owner}, {len(self.values)} variables)"

    def _repr_html_(self) -> str:
        """Show the values as a table in a notebook."""
        rows = [(address, np.array2string(value, precision=5, threshold=6)) for address, value in self.values.items()]
        return f"<b>{escape(repr(self))}</b>{html_table([('address', 'value'), *rows])}"

    def _ipython_key_completions_(self) -> list[str]:
        """Complete ``snapshot["dps.<TAB>`` in IPython."""
        return list(self.values)

    def compare(self, other: Snapshot) -> dict[str, float]:
        """Return the largest absolute difference to another snapshot, by address or group.

        The difference is ``inf`` if only one snapshot has the entry, or if the shapes differ or the values are not real
        numbers. Equal entries (NaN equals NaN) are left out: if ``a.compare(b)`` is empty, the snapshots are identical.
        """
        differences = {} if self.time == other.time else {"time": abs(self.time - other.time)}
        for mine, theirs in ((self.values, other.values), (self.groups, other.groups)):
            for key in [*mine, *(key for key in theirs if key not in mine)]:
                if key not in mine or key not in theirs or mine[key].shape != theirs[key].shape:
                    differences[key] = np.inf
                elif not np.array_equal(mine[key], theirs[key], equal_nan=mine[key].dtype.kind in "fc"):
                    differences[key] = _largest_difference(mine[key], theirs[key])
        return differences

    def save(self, path: str | os.PathLike[str], *, mode: int | None = None) -> None:
        """Write one file (a zip of .npy arrays and a JSON header), whole or not at all.

        Args:
            path: The file.
            mode: Its permissions, as far as the umask leaves them; by default what the umask leaves.
        """
        write_archive(path, mode=mode, kind=KIND, version=VERSION, **self._parts())

    def to_bytes(self) -> bytes:
        """Return the bytes that `save` writes."""
        return archive_bytes(kind=KIND, version=VERSION, **self._parts())

    def _parts(self) -> dict[str, Any]:
        arrays = {f"values/{key}": value for key, value in self.values.items()}
        arrays |= {f"groups/{key}": value for key, value in self.groups.items()}
        header = {"time": self.time, "scenario": dict(check_plain(self.scenario))}
        header |= {"notes": dict(self.notes)} if self.notes else {}
        return {"header": header, "arrays": arrays}

    @classmethod
    def load(cls, source: str | os.PathLike[str] | bytes) -> Snapshot:
        """Return the snapshot of a file that `save` wrote, or of the bytes of `to_bytes`.

        Raises:
            ArchiveError: The source is not a snapshot, is damaged, or was written by another version.
        """
        return read_archive(source, kind=KIND, version=VERSION, make=cls._from_parts)

    @classmethod
    def _from_parts(cls, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Snapshot:
        parts: dict[str, dict[str, np.ndarray]] = {"values": {}, "groups": {}}
        for name, array in arrays.items():
            part, key = name.split("/", 1)
            parts[part][key] = array
        if not isinstance(header["scenario"], dict):
            raise ValueError(f"its scenario is {header['scenario']!r}")
        return cls(float(header["time"]), parts["values"], parts["groups"], header["scenario"], header.get("notes", {}))


def _largest_difference(a: np.ndarray, b: np.ndarray) -> float:
    if a.dtype.kind not in "biuf" or b.dtype.kind not in "biuf":
        return np.inf
    difference = np.abs(a.astype(float) - b.astype(float))
    return float(np.where(np.isnan(difference), np.inf, difference).max())


def take(
    diagram: Diagram, context: Context, variables: Variables, *, scenario: Mapping[str, Any] | None = None
) -> Snapshot:
    """Return the snapshot of ``context``.

    Args:
        diagram: The root Diagram.
        context: Its root context, which stays as it is.
        variables: The variables of the Diagram; all but the derived ones are part of the snapshot.
        scenario: The record of the scenario that built the Diagram; empty by default.

    Raises:
        SnapshotError: A system has an abstract value that neither a codec nor a hidden variable carries. (A testbed
            with such a system is refused when it is built.)
    """
    groups: dict[str, np.ndarray] = {}
    for path, system, numeric in stateful_leaves(diagram, context):
        leaf_context = system.GetMyContextFromRoot(context)
        for kind, index, _ in numeric:
            groups[f"{path}/{kind}/{index}"] = read_group(leaf_context, kind, index)
        for name, array in abstract_state(path, system, leaf_context).read(leaf_context).items():
            groups[f"{path}/abstract/{name}"] = array
    values = {v.address: np.asarray(v.get(context)) for v in variables.values() if not v.derived}
    return Snapshot(context.get_time(), values, groups, scenario or {})


def apply(
    snapshot: Snapshot,
    diagram: Diagram,
    context: Context,
    variables: Variables,
    *,
    only: Callable[[str], bool] = lambda path: True,
) -> None:
    """Set time, state and parameters of ``context`` from ``snapshot``.

    Args:
        snapshot: The snapshot to apply.
        diagram: The Diagram to set the state of.
        context: A root context of ``diagram``.
        variables: The variables of ``diagram``.
        only: Predicate of a path that selects the systems to set; by default all.

    Raises:
        SnapshotError: The Diagram differs in structure from the snapshot's; the context is unchanged.
    """
    systems = list(stateful_leaves(diagram, context, only=only))
    left = {key for key in snapshot.groups if only(key.partition("/")[0])}
    writers = {}
    for path, system, numeric in systems:
        for kind, index, size in numeric:
            key = f"{path}/{kind}/{index}"
            left.discard(key)
            entries = _as_entries(snapshot.groups[key]) if key in snapshot.groups else "no such group"
            if entries != f"{size} entries":
                raise SnapshotError(f"{key} has {size} entries in this testbed, but the snapshot has {entries}")
        state = abstract_state(path, system, system.GetMyContextFromRoot(context))
        if state:
            prefix = f"{path}/abstract/"
            arrays = {key.removeprefix(prefix): snapshot.groups[key] for key in left if key.startswith(prefix)}
            left -= {prefix + key for key in arrays}
            writers[path] = state.writer(arrays)
    if left:
        raise SnapshotError(f"the snapshot has a group {min(left)}, which this testbed does not have")
    hidden = [v for v in variables.values() if v.hidden and not v.derived]
    for variable in hidden:
        if variable.address not in snapshot.values:
            raise SnapshotError(f"the snapshot has no value of {variable.address}, which this testbed has")
        try:
            variable.check(snapshot.values[variable.address])
        except VariableError as error:
            raise SnapshotError(f"the snapshot does not fit: {error}") from error
    context.SetTime(snapshot.time)
    for leaf in systems:
        leaf_context = leaf.system.GetMyMutableContextFromRoot(context)
        if not leaf.holds_ids:
            # Reset the memory of a discrete plant's last step, which a snapshot cannot hold.
            leaf.system.SetDefaultContext(leaf_context)
        for kind, index, _ in leaf.groups:
            write_group(leaf_context, kind, index, snapshot.groups[f"{leaf.path}/{kind}/{index}"])
        if leaf.path in writers:
            writers[leaf.path](leaf_context)
    for variable in hidden:
        # Write only what differs: writing invalidates the caches of SceneGraph and cameras.
        if not np.array_equal(variable.get(context), snapshot.values[variable.address]):
            variable.set(context, snapshot.values[variable.address])


def _as_entries(array: np.ndarray) -> str:
    if array.ndim != 1 or array.dtype != float:
        return f"an array of shape {array.shape} and type {array.dtype}"
    return f"{array.size} entries"


class StateCopier:
    """Copies time, state and parameters leaf by leaf.

    SceneGraph and cameras are left out: they hold ids that differ from build to build, and copying them makes Drake
    recompute unchanged values. Their hidden state is copied by address, and only where it differs.

    Args:
        source, target: The Diagrams; they may be the same one.
        source_variables, target_variables: The variables of the Diagrams.
        only: Predicate of a path that selects the systems of the target to copy; by default all.

    Raises:
        ValueError: The source lacks a system of the target.
    """

    def __init__(
        self,
        source: Diagram,
        source_variables: Variables,
        target: Diagram,
        target_variables: Variables,
        *,
        only: Callable[[str], bool] = lambda path: True,
    ) -> None:
        from_paths = dict(leaves(source))
        self._pairs = []
        for leaf in stateful_leaves(target, only=only):
            if leaf.holds_ids or not (leaf.groups or _has_abstract_values(leaf.system)):
                continue
            if leaf.path not in from_paths:
                raise ValueError(f"the testbed to copy from has no system {leaf.path}")
            self._pairs.append((from_paths[leaf.path], leaf.system))
        self._hidden = [
            (source_variables[v.address], v)
            for v in target_variables.values()
            if v.hidden and not v.derived and v.address in source_variables
        ]

    def copy(self, source: Context, target: Context, *, hidden: Collection[str] | None = None) -> None:
        """Make ``target`` continue as ``source`` would.

        Args:
            source: Context of the source Diagram.
            target: Context of the target Diagram.
            hidden: Addresses of the hidden variables that can differ; by default all.
        """
        target.SetTime(source.get_time())
        for from_system, to_system in self._pairs:
            to_context = to_system.GetMyMutableContextFromRoot(target)
            # A plant's constraints have other ids in each build. Their parameters are hidden variables, as are all
            # others of a plant that are abstract.
            has_ids = from_system is not to_system and is_plant(to_system) and to_system.num_constraints() > 0
            numbers = range(to_context.num_abstract_parameters() if has_ids else 0)
            parameters = [to_context.get_abstract_parameter(number).Clone() for number in numbers]
            to_context.SetStateAndParametersFrom(from_system.GetMyContextFromRoot(source))
            for number, value in zip(numbers, parameters, strict=True):
                to_context.get_mutable_abstract_parameter(number).SetFrom(value)
        for from_variable, to_variable in self._hidden:
            if hidden is not None and to_variable.address not in hidden:
                continue
            value = np.asarray(from_variable.get(source))
            if not np.array_equal(to_variable.get(target), value):
                to_variable.set(target, value)


def _has_abstract_values(system: System) -> bool:
    context = system.CreateDefaultContext()
    return bool(context.num_abstract_states() or context.num_abstract_parameters())
