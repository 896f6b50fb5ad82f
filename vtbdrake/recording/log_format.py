"""The format of a log: LCM events, the header, the layout of a cycle, and changes between cycles."""

from __future__ import annotations

import json
import platform
import re
import struct
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib import metadata
from itertools import accumulate, groupby
from math import inf
from typing import Any, NamedTuple

import numpy as np

from vtbdrake.control.stepping import Change
from vtbdrake.recording.lcm_types.lcmt_vtb_change import lcmt_vtb_change
from vtbdrake.recording.lcm_types.lcmt_vtb_cycle import lcmt_vtb_cycle
from vtbdrake.testbed import DpsAlone, Scenario, ScenarioError, VirtualTestbed
from vtbdrake.testbed.addressed import record_differences
from vtbdrake.testbed.scenario_file import is_imported, scenario_of_text

VERSION = 3
LOG = "VTB_LOG"
STATE = "VTB_STATE"
CYCLE = "VTB_CYCLE"
CHANGE = "VTB_CHANGE"
FAULT = "VTB_FAULT"
DIGEST = "VTB_DIGEST"
END = "VTB_END"
OWN_PREFIX = "VTB_"
"""Prefix of the channels that the recorder itself writes."""

SYNC = 0xEDA1DA01
EVENT = struct.Struct(">IqqII")
"""Head of an event: sync word, event number, time in microseconds, length of the channel name, length of the data."""

MAX_CHANNELS = 10_000
"""Limit on the channels of a log: in memory, a channel costs much more than its smallest event in the file."""
MAX_DAMAGES = 1000
"""Number of damaged places that are reported individually."""
MAX_SIZE = 1 << 20
"""Limit on the entries of all signals of one side together."""

DIGEST_SIZE = 16
VECTOR = -1
"""Value of `lcmt_vtb_cycle.source` for a new value of a vector signal."""
COMMANDED = 1
"""Bit of `lcmt_vtb_cycle.act`: the DPS commanded the signal."""
SENT = 2
"""Bit of `lcmt_vtb_cycle.act`: the command was sent."""

TESTBED = "testbed"
DPS = "dps"
_MAX_COUNT = 1 << 52


class LogError(ValueError):
    """A file that is not a log of a control loop, or a log that does not fit its use."""


def event(number: int, utime: int, channel: bytes, data: bytes) -> bytes:
    """Return one event of an LCM log; ``utime`` is in microseconds since 1970.

    Args:
        number: The number of the event in the log.
        utime: Time of day in microseconds since 1970.
        channel: The name of the LCM channel, in UTF-8.
        data: The encoded message.
    """
    return EVENT.pack(SYNC, number, utime, len(channel), len(data)) + channel + data


class LoggedSignal(NamedTuple):
    """A signal as a log describes it: name, size (None if it is abstract) and unit.

    Attributes:
        name: The name of the signal.
        size: The number of its entries; None if it is abstract.
        unit: Its unit.
    """

    name: str
    size: int | None
    unit: str


class CycleLayout:
    """The layout of the data of a ``VTB_CYCLE`` event, which is the same for all cycles of a log.

    Args:
        sense: The sensor signals.
        act: The actuator signals.

    Attributes:
        dtype: NumPy type of the data, with the fields of `lcmt_vtb_cycle` and its ``fingerprint``.
        fed: Slice of each vector sensor signal in the field ``fed``.
        actuation: Slice of each vector actuator signal in the fields ``commands`` and ``sent``.
    """

    def __init__(self, sense: Sequence[LoggedSignal], act: Sequence[LoggedSignal]) -> None:
        self.fed, self.actuation = _slices(sense), _slices(act)
        self._fixed = {
            "fingerprint": lcmt_vtb_cycle().get_hash(),
            "num_sense": len(sense),
            "num_fed": sum(signal.size or 0 for signal in sense),
            "num_act": len(act),
            "num_commands": sum(signal.size or 0 for signal in act),
        }
        self.dtype = np.dtype(
            [
                ("fingerprint", ">u8"),
                ("utime", ">i8"),
                ("number", ">i8"),
                ("time", ">f8"),
                ("now", ">f8"),
                ("ok", "?"),
                ("num_sense", ">i4"),
                ("source", ">i8", (self._fixed["num_sense"],)),
                ("num_fed", ">i4"),
                ("fed", ">f8", (self._fixed["num_fed"],)),
                ("num_act", ">i4"),
                ("act", "i1", (self._fixed["num_act"],)),
                ("num_commands", ">i4"),
                ("commands", ">f8", (self._fixed["num_commands"],)),
                ("sent", ">f8", (self._fixed["num_commands"],)),
                ("size", ">i4"),
                ("crc", ">u4"),
            ]
        )

    def blank(self) -> np.ndarray:
        """Return a record, of shape (1,), of a cycle in which nothing happened."""
        record = np.zeros(1, self.dtype)
        for name in ("fed", "commands", "sent"):
            record[name] = np.nan
        for name, value in self._fixed.items():
            record[name] = value
        return record

    def fits(self, records: np.ndarray) -> bool:
        """Return whether all records, of shape (n,), have this layout."""
        return all((records[name] == value).all() for name, value in self._fixed.items())


def _slices(signals: Sequence[LoggedSignal]) -> dict[str, slice]:
    vectors = [(signal.name, signal.size) for signal in signals if signal.size is not None]
    ends = accumulate(size for _, size in vectors)
    return {name: slice(end - size, end) for (name, size), end in zip(vectors, ends, strict=True)}


# -- header

_FIELDS: dict[str, tuple[type, ...]] = {
    "scenario": (str,),
    "record": (dict,),
    "target": (str,),
    "period": (int, float),
    "start_time": (int, float),
    "steps": (int,),
    "first_cycle": (int,),
    "initialized": (bool,),
    "idle": (bool,),
    "pace": (str, type(None)),
    "positions": (dict,),
    "versions": (dict,),
}
"""Allowed JSON types of a header's fields."""


def installed_versions() -> dict[str, str]:
    """Return the versions of vtbdrake, drake and Python that run here."""
    try:
        vtbdrake_version = metadata.version("vtbdrake")
    except metadata.PackageNotFoundError:
        vtbdrake_version = "not installed"
    return {"vtbdrake": vtbdrake_version, "drake": metadata.version("drake"), "python": platform.python_version()}


@dataclass(frozen=True, kw_only=True)
class LogHeader:
    """The first event of a log: a description of the recorded loop, from which it can be built again.

    Attributes:
        version: Version of the format.
        scenario: Text of the scenario as `Scenario.save` writes it; empty if it was built by hand or is not plain data.
        record: What identifies the scenario, see `Scenario.record`.
        target: ``testbed``, or ``dps`` if the DPS was stepped alone.
        sense, act, commands: The signals.
        period: Period of the loop in seconds.
        start_time: Time of the DPS in seconds from which its steps count.
        steps: Number of steps before the first recorded cycle.
        first_cycle: Number of the first recorded cycle.
        initialized, idle: See `Runtime`.
        pace: The sensor signal that began the cycles; None for the clock.
        positions: Positions of a testbed's switches before the first recorded cycle.
        versions: Versions of vtbdrake, drake and Python.
    """

    version: int = VERSION
    scenario: str
    record: Mapping[str, Any]
    target: str
    sense: Sequence[LoggedSignal]
    act: Sequence[LoggedSignal]
    commands: Sequence[LoggedSignal]
    period: float
    start_time: float
    steps: int
    first_cycle: int
    initialized: bool
    idle: bool
    pace: str | None
    positions: Mapping[str, Mapping[str, str]]
    versions: Mapping[str, str] = field(default_factory=installed_versions)

    def to_json(self) -> str:
        """Return the header as JSON."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> LogHeader:
        """Return the header that `to_json` has written.

        Raises:
            LogError: The text is not a header, or is one of another version.
        """
        try:
            values = json.loads(text)
            if values["version"] != VERSION:
                raise LogError(f"the log has the format {values['version']}, this version of vtbdrake reads {VERSION}")
            for side in ("sense", "act", "commands"):
                values[side] = tuple(LoggedSignal(*signal) for signal in values[side])
            header = cls(**values)
            header._check_fields()
            return header
        except LogError:
            raise
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            raise LogError(f"the log's header cannot be read: {error!r}") from error

    def _check_fields(self) -> None:
        for name, kinds in _FIELDS.items():
            if type(value := getattr(self, name)) not in kinds:
                raise ValueError(f"{name} cannot be {str(value)[:50]!r}")
        if self.target not in (TESTBED, DPS) or not 0.0 < self.period < inf or not abs(self.start_time) < inf:
            raise ValueError(f"target {self.target!r}, period {self.period}, start_time {self.start_time}")
        if not 0 <= self.steps < _MAX_COUNT or not 0 <= self.first_cycle < _MAX_COUNT:
            raise ValueError(f"steps {self.steps}, first_cycle {self.first_cycle}")
        for signals in (self.sense, self.act, self.commands):
            for name, size, unit in signals:
                if not isinstance(name, str) or not isinstance(unit, str) or not (size is None or type(size) is int):
                    raise ValueError(f"a signal cannot be {str((name, size, unit))[:50]}")
            sizes = [size for _, size, _ in signals if size is not None]
            if min(sizes, default=0) < 0 or sum(sizes) > MAX_SIZE or len(signals) > MAX_SIZE:
                raise ValueError(f"the signals of one side together have more than {MAX_SIZE} entries, or less than 0")
        if not all(isinstance(side, dict) for side in self.positions.values()):
            raise ValueError(f"positions cannot be {str(self.positions)[:50]!r}")

    @property
    def scenario_name(self) -> str:
        """Return ``package.module:Class`` of the scenario; empty if the log does not say how to build one."""
        return str(self.record.get("scenario", "")) if self.scenario else ""

    @property
    def of_main_module(self) -> bool:
        """Return whether the class of the scenario is one of a script or a notebook, which others cannot import."""
        return self.scenario_name.startswith("__main__:")

    def make_scenario(self) -> Scenario:
        """Return the scenario that was recorded. Its module must be imported already.

        Raises:
            LogError: The module is not imported, or the scenario cannot be loaded or has changed since.
        """
        if not self.scenario:
            raise LogError("the log does not say how to build its scenario: pass the target to replay it with")
        name = self.scenario_name
        if self.of_main_module and not hasattr(sys.modules["__main__"], name.partition(":")[2]):
            raise LogError(
                f"the log is of the scenario {name}, a class of a script or a notebook: only there can it be replayed. "
                "Define scenarios that are recorded in modules"
            )
        if not is_imported(name):
            raise LogError(
                f"the log is of the scenario {name}, and importing its module runs its code: if you trust it, import "
                f"it first, or name it on the command line (vtbdrake replay FILE --scenario {name})"
            )
        try:
            scenario = scenario_of_text(name, self.scenario)
        except ScenarioError as error:
            raise LogError(f"the scenario of the log, {name}, cannot be loaded in this version: {error}") from error
        # Older versions wrote the entries of dictionaries in alphabetical order.
        scenario.take_order(self.record)
        self.check_scenario(scenario)
        return scenario

    def check_scenario(self, scenario: Scenario | None) -> None:
        """Check that this scenario was recorded.

        Raises:
            LogError: Another one was recorded, or another version of it; the error lists the differences.
        """
        differing = record_differences(self.record, scenario_record(scenario), where="in the log")
        if scenario is not None:
            differing += scenario.order_differences(self.record, where="in the log")
        if differing:
            raise LogError(f"the log is of another scenario, or of another version of it ({'; '.join(differing)})")


def target_kind(target: VirtualTestbed | DpsAlone) -> str:
    """Return `LogHeader.target` for a target."""
    return DPS if isinstance(target, DpsAlone) else TESTBED


def scenario_record(scenario: Scenario | None) -> Any:
    """Return `Scenario.record` as it is after a JSON round trip."""
    record = scenario.record() if scenario is not None else {}
    return json.loads(json.dumps(record, default=lambda value: getattr(value, "__qualname__", None) or repr(value)))


# -- changes between two cycles


def encode_changes(changes: Iterable[Change], number: int, utime: int) -> Iterator[lcmt_vtb_change]:
    """Yield the messages of the changes before the step of cycle ``number``.

    Args:
        changes: The changes before the step, each a kind and its values, in their order.
        number: The number of the cycle.
        utime: Time of day in microseconds since 1970.
    """
    for index, (kind, values) in enumerate(changes):
        for address, name, value in _entries(values):
            array = np.ascontiguousarray(value)
            message = lcmt_vtb_change()
            message.utime, message.number, message.change = utime, number, index
            message.kind, message.address, message.name = kind, address, name
            message.dtype, message.shape = array.dtype.str, np.shape(value)
            message.ndim = len(message.shape)
            message.data = array.tobytes()
            message.size = len(message.data)
            yield message


def _entries(values: Mapping[str, Any]) -> Iterator[tuple[str, str, Any]]:
    if not values:
        yield "", "", 0
    for address, value in values.items():
        if isinstance(value, Mapping):
            yield from ((address, name, part) for name, part in value.items())
        else:
            yield address, "", value


def decode_changes(messages: Iterable[lcmt_vtb_change]) -> list[tuple[int, Change]]:
    """Return the changes of messages that `change_value` accepts, in order, each with the number of its cycle."""
    changes = []
    for (number, _), group in groupby(messages, key=lambda message: (message.number, message.change)):
        values: dict[str, Any] = {}
        kind = ""
        for message in group:
            kind = message.kind
            if message.name:
                parts = values.setdefault(message.address, {})
                if isinstance(parts, dict):
                    parts[message.name] = change_value(message)
            elif message.address:
                values[message.address] = change_value(message)
        changes.append((number, Change(kind, values)))
    return changes


def change_value(message: lcmt_vtb_change) -> Any:
    """Return the number, the text, or the array of those, that a message carries.

    Raises:
        ValueError: The message carries something else.
    """
    if not re.fullmatch(r"[<>|][biufU][0-9]{1,5}", message.dtype) or any(size < 0 for size in message.shape):
        raise ValueError(f"an array of type {message.dtype[:20]!r} and shape {message.shape[:9]}")
    array = np.frombuffer(message.data, np.dtype(message.dtype)).reshape(message.shape)
    return array if message.shape else array.item()
