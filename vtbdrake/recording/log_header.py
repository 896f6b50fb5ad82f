"""What a log says of itself: what was recorded, and how it can be built again."""

from __future__ import annotations

import json
import logging
import platform
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib import metadata
from math import inf
from pathlib import Path
from typing import Any

from vtbdrake.control.runtime import Runtime
from vtbdrake.recording.log_format import MAX_SIZE, VERSION, LogError, LoggedSignal
from vtbdrake.testbed import DpsAlone, Scenario, ScenarioError, Signal, VirtualTestbed, load_scenario
from vtbdrake.testbed.scenario import is_imported

_log = logging.getLogger(__name__)

TESTBED, DPS = "testbed", "dps"

_LARGE = 1 << 52
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
"""What the JSON of a header's fields may be."""


@dataclass(frozen=True, kw_only=True)
class LogHeader:
    """The first event of a log.

    Attributes:
        version: of the format.
        scenario: as `Scenario.save` writes it; empty where what ran was built by hand, or is not plain data.
        record: what identifies the scenario, see `Scenario.record`.
        target: ``testbed`` or ``dps``, which is the DPS alone.
        sense, act, commands: the signals.
        period: of the loop, in seconds.
        start_time: of the DPS, in seconds, from which its steps count.
        steps: that it had done before the first recorded cycle.
        first_cycle: number of the first recorded cycle.
        initialized, idle: see `Runtime`.
        pace: the sensor signal that began the cycles; None for the clock.
        positions: of a testbed's switches, before the first recorded cycle.
        versions: of vtbdrake, drake and python.
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
    versions: Mapping[str, str] = field(default_factory=lambda: versions())

    @classmethod
    def of(cls, runtime: Runtime) -> LogHeader:
        """That of a loop, as it stands now."""
        target, interface = runtime.target, runtime.target.interface
        return cls(
            scenario=_text(target.scenario) if target.scenario else "",
            record=_record(target.scenario),
            target=kind_of(target),
            sense=_logged(interface.sense),
            act=_logged(interface.act),
            commands=_logged(interface.commands),
            period=runtime.period,
            start_time=runtime.start_time,
            steps=runtime.steps,
            first_cycle=runtime.cycles,
            initialized=runtime.initialized,
            idle=runtime.idle,
            pace=runtime.pace,
            positions=target.positions(runtime.context) if isinstance(target, VirtualTestbed) else {},
        )

    def to_json(self) -> str:
        """The text of the event."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> LogHeader:
        """The inverse of `to_json`.

        Raises:
            LogError: it is of another version, or something else.
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
        """
        Raises:
            ValueError: a field is not what it can be.
        """
        for name, kinds in _FIELDS.items():
            if type(value := getattr(self, name)) not in kinds:
                raise ValueError(f"{name} cannot be {str(value)[:50]!r}")
        if self.target not in (TESTBED, DPS) or not 0.0 < self.period < inf or not abs(self.start_time) < inf:
            raise ValueError(f"target {self.target!r}, period {self.period}, start_time {self.start_time}")
        if not 0 <= self.steps < _LARGE or not 0 <= self.first_cycle < _LARGE:
            raise ValueError(f"steps {self.steps}, first_cycle {self.first_cycle}")
        for signals in (self.sense, self.act, self.commands):
            for name, size, unit in signals:
                if not isinstance(name, str) or not isinstance(unit, str) or not (size is None or type(size) is int):
                    raise ValueError(f"a signal cannot be {str((name, size, unit))[:50]}")
            sizes = [size for _, size, _ in signals if size is not None]
            if min(sizes, default=0) < 0 or sum(sizes) > MAX_SIZE or len(signals) > MAX_SIZE:
                raise ValueError(f"the signals of one side have together at most {MAX_SIZE} numbers")
        if not all(isinstance(side, dict) for side in self.positions.values()):
            raise ValueError(f"positions cannot be {str(self.positions)[:50]!r}")

    @property
    def scenario_name(self) -> str:
        """Return ``package.module:Class`` of the scenario; empty if the log does not tell how to build one."""
        return str(self.record.get("scenario", "")) if self.scenario else ""

    def make_scenario(self) -> Scenario:
        """Return the scenario that was recorded. Its module must be imported already.

        Raises:
            LogError: it is not imported, cannot be loaded, or is another one by now.
        """
        if not self.scenario:
            raise LogError("the log does not tell how its scenario is built: give what it is to be replayed with")
        name = self.scenario_name
        if not is_imported(name):
            raise LogError(
                f"the log is of the scenario {name}, and to import its module runs its code: if you trust it, import "
                f"it first, or name it on the command line (vtbdrake replay FILE --scenario {name})"
            )
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "scenario.yaml"
            path.write_text(self.scenario)
            try:
                scenario = load_scenario(f"{name}@{path}")
            except ScenarioError as error:
                raise LogError(f"the scenario of the log, {name}, is not to be had in this version: {error}") from error
        self.check(scenario)
        return scenario

    def check(self, scenario: Scenario | None) -> None:
        """
        Raises:
            LogError: another one was recorded; it says what differs.
        """
        mine = _record(scenario)
        keys = ["scenario"] if mine.get("scenario") != self.record.get("scenario") else sorted({*mine, *self.record})
        nothing = object()
        differing = [
            f"{key}: {self.record.get(key, 'nothing')!r} in the log, {mine.get(key, 'nothing')!r} here"
            for key in keys
            if mine.get(key, nothing) != self.record.get(key, nothing)
        ]
        if differing:
            raise LogError(f"the log is of another scenario, or of another version of it ({'; '.join(differing)})")


def kind_of(target: VirtualTestbed | DpsAlone) -> str:
    """`LogHeader.target` of what is stepped."""
    return DPS if isinstance(target, DpsAlone) else TESTBED


def versions() -> dict[str, str]:
    """What runs here."""
    try:
        own = metadata.version("vtbdrake")
    except metadata.PackageNotFoundError:
        own = "not installed"
    return {"vtbdrake": own, "drake": metadata.version("drake"), "python": platform.python_version()}


def _text(scenario: Scenario) -> str:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scenario.yaml"
        try:
            scenario.save(path)
        except Exception as error:  # Drake's writer refuses types in many ways, failed assertions among them.
            _log.warning("YAML cannot hold the scenario, whoever replays the log must bring it: %r", error)
            return ""
        return path.read_text()


def _record(scenario: Scenario | None) -> Any:
    """As `Scenario.record`, after the way through a file."""
    record = scenario.record() if scenario is not None else {}
    return json.loads(json.dumps(record, default=lambda value: getattr(value, "__qualname__", None) or repr(value)))


def _logged(signals: Sequence[Signal]) -> tuple[LoggedSignal, ...]:
    return tuple(LoggedSignal(signal.name, signal.size, signal.unit) for signal in signals)
