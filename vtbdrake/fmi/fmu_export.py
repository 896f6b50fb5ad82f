"""Testbeds, their DPS and their worlds as functional mock-up units (FMI 3.0, co-simulation)."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import sys
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from math import inf
from pathlib import Path

from vtbdrake.common.argument_checks import as_number
from vtbdrake.common.child_process import search_path
from vtbdrake.common.extras import extra_module
from vtbdrake.components.casadi_system.compiler import compile_library
from vtbdrake.fmi.coupled import PART, SCENARIO, START, coupled_model
from vtbdrake.fmi.exported_part import ExportedPart, ExportedVariable
from vtbdrake.fmi.model_description import model_description
from vtbdrake.fmi.native import array, native_model
from vtbdrake.state.archive import whole_file
from vtbdrake.testbed import Scenario
from vtbdrake.testbed.scenario import check_is_scenario

KINDS = ("native", "coupled")

# s, where nothing in the Diagram has a period.
_STEP = 0.01


def export_fmu(
    scenario: Scenario,
    path: str | os.PathLike[str],
    *,
    outputs: Sequence[str] | Mapping[str, str] | None = None,
    inputs: Sequence[str] | Mapping[str, str] | None = None,
    parameters: Sequence[str] | Mapping[str, str] = (),
    part: str = "testbed",
    kind: str = "native",
    step: float | None = None,
) -> Path:
    """Write a testbed, its DPS or its world as an FMU for co-simulation (FMI 3.0) on Linux.

    Its variables have the names of the addresses, or the names that a mapping ``{name: address}`` gives them. Numbers
    are Float64; what has a shape is an array. The importer may save and restore its state at any communication point,
    and its steps may have any length. As in a rollout, outputs at a communication point show the state before the
    updates of that instant, and inputs hold during a step.

    Args:
        scenario: The scenario.
        path: The file to write, such as ``cart_pole.fmu``; whole or not at all.
        outputs: Variables and vector output ports. By default the actuator signals of a ``dps``, and the sensor
            signals of a ``world``; signals have the names of the interface.
        inputs: Variables that the importer sets between steps. By default the commands u, the sensor signals of a
            ``dps``, and the actuator signals of a ``world``.
        parameters: Variables that the importer sets before it begins: dynamic ones (x) give the start; static ones (a)
            can be set between steps, too.
        part: ``testbed``; ``dps``: the DPS alone; or ``world``: the simulated world alone.
        kind: ``native``: machine code of the compiled testbed, which needs nothing else, and whose trajectories equal
            `VirtualTestbed.compiled`'s to the last bit. ``coupled``: any testbed, computed by Drake in a Python process
            that the FMU starts: on this machine, or on one where the environment variable VTBDRAKE_PYTHON names a
            Python with vtbdrake and the scenario's module.
        step: The communication step (s) that the FMU proposes; by default the least period in it.

    Returns:
        The path.

    Raises:
        UnsupportedTestbedError: A native FMU cannot be compiled; the error names what to do.
        CompiledDifferenceError: What is compiled differs from Drake.
        CompilerError: There is no C compiler, or it fails.
        ModuleNotFoundError: FMPy is not installed, which the extra ``fmi`` installs.
        ValueError: An argument does not fit, or an address does not exist.
    """
    check_is_scenario(scenario)
    if kind not in KINDS:
        raise ValueError(f"kind is {' or '.join(KINDS)}, not {kind!r}")
    header = Path(extra_module("fmpy", purpose="export_fmu", extra="fmi").__file__).parent / "c-code"
    exported = ExportedPart(scenario, part, inputs=inputs, parameters=parameters, outputs=outputs)
    step = _checked_step(exported, step)
    model = native_model(exported, step) if kind == "native" else coupled_model()
    name = type(scenario).__name__
    identifier = re.sub(r"\W", "_", name, flags=re.ASCII)
    files: dict[str, bytes] = _resources(exported) if kind == "coupled" else {}
    front = "\n".join((_tables(exported), Path(__file__).with_name("fmu.c").read_text("utf-8"), model))
    token = hashlib.sha256(b"\0".join([front.encode(), *files.values()])).hexdigest()
    source = f'#include "{header}/fmi3FunctionTypes.h"\n#include <math.h>\n#define TOKEN "{token}"\n{front}'
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / f"{identifier}.so"
        compile_library(source, library)
        files[f"binaries/{platform.machine()}-linux/{identifier}.so"] = library.read_bytes()
    files["modelDescription.xml"] = model_description(
        exported.variables,
        name=name,
        identifier=identifier,
        token=token,
        step=step,
        is_coupled=kind == "coupled",
    )
    _write(Path(path), files)
    return Path(path)


def _checked_step(part: ExportedPart, step: float | None) -> float:
    if step is None:
        return min((period for period, _ in part.target.event_timings()), default=_STEP)
    if not 0.0 < as_number("export_fmu: step", step) < inf:
        raise ValueError(f"export_fmu: step is a positive time in s, not {step}")
    return float(step)


def _tables(part: ExportedPart) -> str:
    """Return the definitions that ``fmu.c`` needs."""
    rows = ['{"time", TIME, 0, 1}', *_rows("SETTABLE", part.settable), *_rows("OUTPUT", part.outputs)]
    settable = part.settable
    sizes = {
        "N_VARIABLES": len(rows),
        "N_VALUES": sum(variable.size for variable in settable),
        "N_OUTPUTS": sum(variable.size for variable in part.outputs),
    }
    values = {
        "start_values": [x for v in settable if v.start is not None for x in v.start],
        "lower_values": [x for v in settable for x in v.lower],
        "upper_values": [x for v in settable for x in v.upper],
    }
    return "\n".join(
        (
            *(f"#define {name} {size}" for name, size in sizes.items()),
            "typedef enum { TIME, SETTABLE, FIXED, OUTPUT } Kind;",
            "typedef struct { const char *name; Kind kind; int first, size; } Variable;",
            f"static const Variable variables[] = {{{', '.join(rows)}}};",
            *(array(name, numbers) for name, numbers in values.items()),
        )
    )


def _rows(kind: str, variables: Sequence[ExportedVariable]) -> list[str]:
    rows, first = [], 0
    for variable in variables:
        name = json.dumps(variable.name)
        rows.append(f"{{{name}, {'FIXED' if variable.is_fixed else kind}, {first}, {variable.size}}}")
        first += variable.size
    return rows


def _resources(part: ExportedPart) -> dict[str, bytes]:
    """Return the files from which the Python process of a coupled FMU makes the part again.

    Raises:
        ValueError: The process could not import the scenario.
    """
    name = part.scenario.name()
    if name.startswith("__main__:") or "<locals>" in name:
        raise ValueError(f"the Python process of a coupled FMU cannot import {name}: define the scenario in a module")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / SCENARIO
        part.scenario.save(file)
        scenario = file.read_bytes()
    arguments = json.dumps({"scenario": name, "part": part.part, **part.addresses()}, indent=1).encode()
    start = START.format(executable=sys.executable, path=search_path())
    return {
        f"resources/{SCENARIO}": scenario,
        f"resources/{PART}": arguments,
        "resources/start.py": start.encode(),
    }


def _write(path: Path, files: Mapping[str, bytes]) -> None:
    """Write a zip file, whole or not at all; the same files give the same bytes."""
    with whole_file(path) as partial, zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(files):
            archive.writestr(zipfile.ZipInfo(name), files[name], zipfile.ZIP_DEFLATED)
