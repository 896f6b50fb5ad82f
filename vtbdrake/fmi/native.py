"""A compiled testbed as C code of an FMU."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import casadi

from vtbdrake.compiled import CompiledRollouts, UnsupportedTestbedError
from vtbdrake.components.casadi_system.compiler import kernel_sources
from vtbdrake.fmi.exported_part import ExportedPart

_INSTEAD = "; or export it with kind='coupled', which computes in Drake"

_TYPES = """\
typedef int (*Function)(const double **, double **, casadi_int *, double *, int);
typedef struct { double period, offset; int unrestricted; } Timing;
"""


def native_model(part: ExportedPart, step: float) -> str:
    """Return the C code of a part, which defines the functions ``model_...`` of ``fmu.c``.

    Args:
        part: The part.
        step: The communication step (s) with which it is compared with Drake.

    Raises:
        UnsupportedTestbedError: It cannot be compiled, or draws random numbers.
        CompiledDifferenceError: What is compiled differs from Drake.
        ValueError: An input or parameter cannot be varied, or an output not be recorded.
    """
    target = part.target
    timings = target.event_timings()
    horizon = max(10.0 * step, *(2.0 * period + offset for period, offset in timings), 0.0)
    try:
        rollouts = CompiledRollouts(
            target.diagram,
            target.variables(),
            target.default_context(),
            horizon=horizon,
            sample_period=step,
            parameters=[variable.address for variable in part.settable],
            outputs=[variable.address for variable in part.outputs],
            timings=timings,
            compile=False,
        )
        _refuse_draws(rollouts)
        if rollouts.walker.endings:
            raise UnsupportedTestbedError(
                f"{rollouts.walker.endings[0][0]} ends the simulation, which no native FMU does: leave it out"
            )
    except UnsupportedTestbedError as error:
        raise UnsupportedTestbedError(f"{error}{_INSTEAD}") from None
    return "\n".join((_functions(rollouts), _TYPES, _tables(part, rollouts), _text("native.c")))


def _refuse_draws(rollouts: CompiledRollouts) -> None:
    draws = list(rollouts.walker.draws.placed.values())
    if draws:
        raise UnsupportedTestbedError(
            f"{draws[0].path} draws random numbers, or reads samples of a recording, which no native FMU has: set its "
            "errors to 0"
        )


def _functions(rollouts: CompiledRollouts) -> str:
    """Return the C code of the updates and of the record, with what it calls; nothing of it is visible outside."""
    generator = casadi.CodeGenerator("model.c", {})
    for function in (*rollouts.updates, rollouts.record):
        generator.add(function)
    source = generator.dump()
    kernels = kernel_sources(source)
    if len(kernels) > 1:
        raise UnsupportedTestbedError("there are two plants with contact, and a native FMU has one at most")
    hidden = ["#pragma GCC visibility push(hidden)", *kernels, source, "#pragma GCC visibility pop"]
    return "\n".join(hidden)


def _tables(part: ExportedPart, rollouts: CompiledRollouts) -> str:
    """Return the definitions that `native.c` needs."""
    walker, functions = rollouts.walker, [*rollouts.updates, rollouts.record]
    places = [i for v in part.settable for i in range(*walker.place(v.address).indices(walker.vector.size))]
    timings = ", ".join(f"{{{number(t.period)}, {number(t.offset)}, {int(t.unrestricted)}}}" for t in walker.timings)
    numbers = {
        "NZ": walker.vector.size,
        "NW": functions[-1].numel_in(2),
        "N_TIMINGS": len(walker.timings),
        "N_ARGUMENTS": max(function.sz_arg() for function in functions),
        "N_RESULTS": max(function.sz_res() for function in functions),
        "N_IWORK": max(function.sz_iw() for function in functions),
        "N_WORK": max(function.sz_w() for function in functions),
    }
    updates = ", ".join(function.name() for function in rollouts.updates)
    return "\n".join(
        (
            *(f"#define {name} {value}" for name, value in numbers.items()),
            array("z_start", rollouts.z_of(walker.context)),
            f"static const int places[] = {{{', '.join(map(str, [*places, 0]))}}};",
            f"static const Timing timings[] = {{{timings or '{0}'}}};",
            f"static const char *const reasons[] = {{{', '.join(map(json.dumps, walker.reasons))}}};",
            f"static const Function updates[] = {{{updates or '0'}}};",
        )
    )


def array(name: str, values: Iterable[float]) -> str:
    """Return the definition of a constant array in C, exact to the last bit, with a 0 behind its values.

    Args:
        name: Its name.
        values: Its values.
    """
    return f"static const double {name}[] = {{{', '.join([*map(number, values), '0.0'])}}};"


def number(value: float) -> str:
    """Return a number in C, exact to the last bit."""
    text = float(value).hex()
    return {"inf": "INFINITY", "-inf": "-INFINITY", "nan": "NAN"}.get(text, text)


def _text(name: str) -> str:
    return Path(__file__).with_name(name).read_text("utf-8")
