"""What the file of an FMU says, and the checks of it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import inf, prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vtbdrake.common.extras import extra_module
from vtbdrake.common.failures import one_line
from vtbdrake.common.suggestions import did_you_mean

# How many names an error lists.
_LISTED = 12
# The types of variables that have numbers, of FMI 2 and 3: the suffix of FMPy's functions, and how they are stored.
_NUMBERS: dict[str, tuple[str, Any]] = {
    "Real": ("Real", np.float64),
    "Integer": ("Integer", np.int32),
    "Float64": ("Float64", np.float64),
    "Float32": ("Float32", np.float32),
    "Boolean": ("Boolean", np.bool_),
    **{name: (name, getattr(np, name.lower())) for name in ("Int8", "Int16", "Int32", "Int64")},
    **{f"U{name}": (f"U{name}", getattr(np, f"u{name.lower()}")) for name in ("Int8", "Int16", "Int32", "Int64")},
}


class FmuVariable(NamedTuple):
    """A variable of an FMU that holds numbers, or a text.

    Attributes:
        name: Its name.
        reference: Its value reference.
        type: The type as FMPy's functions name it, such as ``Float64``.
        dtype: The numpy type in which it is stored; None for a text.
        shape: Its shape; ``()`` is a scalar.
        unit: Its unit; ``"1"`` if it has none.
        is_tunable: Whether it is a parameter that can be set between steps.
    """

    name: str
    reference: int
    type: str
    dtype: Any
    shape: tuple[int, ...]
    unit: str
    is_tunable: bool

    @property
    def size(self) -> int:
        """Return the number of entries."""
        return prod(self.shape)


class ImportedFmu:
    """The file of an FMU.

    Args:
        path: The file.
        fork: Whether its state has to be saved and restored.

    Attributes:
        path: The file.
        fmpy: The module FMPy.
        description: FMPy's model description.
        can_fork: Whether its state can be saved and restored, as bytes.
        once: Whether a process can have one instance only.

    Raises:
        FileNotFoundError: There is no such file.
        ModuleNotFoundError: FMPy is not installed, which the extra ``fmi`` installs.
        ValueError: It is no FMU for co-simulation by FMI 2 or 3 on this platform, or cannot save its state.
    """

    def __init__(self, path: str | os.PathLike[str], *, fork: bool) -> None:
        self.fmpy = extra_module("fmpy", purpose="FmuSystem", extra="fmi")
        self.path = Path(path)
        if not self.path.is_file():
            raise FileNotFoundError(f"there is no FMU {self.path}: correct the path")
        try:
            self.description = self.fmpy.read_model_description(str(self.path), validate=False)
        except Exception as error:  # What the zip, XML and FMPy raise.
            raise ValueError(f"{self.path} is no FMU that FMPy can read: {one_line(error)}") from error
        version, simulated = self.description.fmiVersion or "none", self.description.coSimulation
        if not version.startswith(("2.", "3.")):
            raise ValueError(f"{self.name} is of FMI {version}: export it for FMI 3 or 2")
        if simulated is None:
            raise ValueError(
                f"{self.name} is no FMU for co-simulation, but for model exchange or scheduled execution: export it "
                "for co-simulation"
            )
        self._check_platform(simulated.modelIdentifier)
        self.can_fork = bool(simulated.canGetAndSetFMUstate and simulated.canSerializeFMUstate)
        if fork and not self.can_fork:
            raise ValueError(
                f"{self.name} cannot save and restore its state (canGetAndSetFMUState and canSerializeFMUState): its "
                "simulation could neither fork nor begin at a snapshot; export it with both, or give fork=False"
            )
        self.once = bool(simulated.canBeInstantiatedOnlyOncePerProcess)
        self._variables = {variable.name: variable for variable in self.description.modelVariables}

    @property
    def name(self) -> str:
        """Return the name of the file."""
        return self.path.name

    @property
    def is_fmi2(self) -> bool:
        """Return whether it is of FMI 2, not 3."""
        return bool(self.description.fmiVersion.startswith("2."))

    def proposed_step(self) -> float | None:
        """Return the communication step that the file proposes, in s, if it does."""
        experiment = self.description.defaultExperiment
        steps = (self.description.coSimulation.fixedInternalStepSize, experiment and experiment.stepSize)
        return next((float(step) for step in steps if step), None)

    def start(self, variable: FmuVariable) -> np.ndarray:
        """Return the start value that the file tells, flat; zeros if it tells none."""
        text = self._variables[variable.name].start
        words = [] if text is None else str(text).split()
        values = np.array([{"true": 1.0, "false": 0.0}.get(word) or float(_number(word)) for word in words])
        return np.array(np.broadcast_to(values, (variable.size,))) if values.size else np.zeros(variable.size)

    def bounds(self, variable: FmuVariable) -> tuple[float, float]:
        """Return the least and the largest value that the file allows."""
        listed = self._variables[variable.name]
        lower, upper = (None if bound is None else float(bound) for bound in (listed.min, listed.max))
        return (-inf if lower is None else lower), (inf if upper is None else upper)

    def of_causality(self, causality: str) -> list[FmuVariable]:
        """Return all inputs, or all outputs, that hold numbers."""
        return [
            self._variable(listed)
            for listed in self._variables.values()
            if listed.causality == causality and listed.type in (*_NUMBERS, "Enumeration")
        ]

    def ports(self, causality: str, selection: Sequence[str] | Mapping[str, str | Sequence[str]] | None) -> Ports:
        """Return the variables of each port.

        Args:
            causality: ``input`` or ``output``.
            selection: Names of variables, each with a port of its name; or port -> the variables that it is made of; or
                None for all.

        Raises:
            ValueError: A variable is not there, is named twice, or holds no numbers.
        """
        if selection is None:
            return {variable.name: [variable] for variable in self.of_causality(causality)}
        if isinstance(selection, str):
            raise ValueError(f"FmuSystem: {causality}s are names in a list, not {selection!r}")
        groups = selection if isinstance(selection, Mapping) else {name: name for name in selection}
        names = {port: [of] if isinstance(of, str) else list(of) for port, of in groups.items()}
        every = [name for of in names.values() for name in of]
        if twice := [name for name in every if every.count(name) > 1]:
            raise ValueError(f"FmuSystem: the {causality} {twice[0]!r} of {self.name} is named twice")
        there = [variable.name for variable in self.of_causality(causality)]
        return {
            port: [self._checked(name, lambda v: v.causality == causality, f"{causality}s", there) for name in of]
            for port, of in names.items()
        }

    def parameter(self, name: str) -> FmuVariable:
        """Return a variable that has a start value to be set.

        Raises:
            ValueError: There is no such variable, or it has none.
        """
        there = [v.name for v in self._variables.values() if _has_start(v)]
        return self._checked(name, _has_start, "parameters and start values", there, texts=True)

    def _checked(
        self, name: str, fits: Callable[[Any], bool], kind: str, there: Sequence[str], *, texts: bool = False
    ) -> FmuVariable:
        listed = self._variables.get(name)
        if listed is None or not fits(listed):
            reason = "no such variable" if listed is None else f"one with the causality {listed.causality}"
            raise ValueError(
                f"FmuSystem: {name!r} is none of the {kind} of {self.name}, but {reason}; it has "
                f"{listing(there)}{did_you_mean(name, there)}"
            )
        if listed.type not in (*_NUMBERS, "Enumeration", *(["String"] if texts else [])):
            raise ValueError(f"FmuSystem: {name!r} of {self.name} is of the type {listed.type}, and ports take numbers")
        return self._variable(listed)

    def _variable(self, listed: Any) -> FmuVariable:
        kind = ("Integer" if self.is_fmi2 else "Int64") if listed.type == "Enumeration" else listed.type
        suffix, dtype = _NUMBERS.get(kind, (kind, None))
        unit = listed.unit or (listed.declaredType.unit if listed.declaredType is not None else None) or "1"
        is_tunable = listed.causality == "parameter" and listed.variability == "tunable"
        shape = tuple(int(length) for length in listed.shape or ())
        return FmuVariable(listed.name, listed.valueReference, suffix, dtype, shape, unit, is_tunable)

    def _check_platform(self, identifier: str) -> None:
        folder = self.fmpy.platform if self.is_fmi2 else self.fmpy.platform_tuple
        files = self._files()
        if f"binaries/{folder}/{identifier}.so" not in files:
            folders = {file.split("/")[1] for file in files if file.startswith("binaries/") and file.count("/") > 1}
            raise ValueError(
                f"{self.name} has no binaries/{folder}/{identifier}.so, which this computer needs, but binaries for "
                f"{', '.join(sorted(folders)) or 'no platform'}: export it for {folder}"
            )

    def _files(self) -> set[str]:
        import zipfile

        with zipfile.ZipFile(self.path) as archive:
            return set(archive.namelist())


Ports = dict[str, list[FmuVariable]]


def listing(names: Iterable[str]) -> str:
    """Return names as text, the first ones of many."""
    names = list(names)
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(names[:_LISTED]) + more or "none"


def _has_start(listed: Any) -> bool:
    is_settable = listed.variability != "constant" and listed.initial in ("exact", "approx")
    return listed.causality in ("parameter", "output", "local") and (listed.causality == "parameter" or is_settable)


def _number(word: str) -> str:
    return {"true": "1", "false": "0"}.get(word, word)
