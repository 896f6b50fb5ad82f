"""Time of ``import vtbdrake``."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import partial
from pathlib import Path

from benchmarks.measure import LOWER, Benchmark, interleaved_values, ratio, spread

ROOT = Path(__file__).resolve().parents[1]

# Timed inside a new interpreter, so that its own start does not count.
_PROGRAM = "import time; begin = time.perf_counter(); {}; print(time.perf_counter() - begin)"

# All public names, whether they are loaded on import or at their first use.
EVERYTHING = "from vtbdrake import *"


def import_time(repeats: int = 9, longer: int = 3, warm_up: int = 1) -> list[Benchmark]:
    """Time of ``import vtbdrake`` against ``import pydrake``.

    All public names are compared with the parts of pydrake that they use, and, without a goal, with
    ``import pydrake.all``.

    Args:
        repeats: Repeats of the first, which takes the shortest time.
        longer: Repeats of the others.
        warm_up: Imports of each that are not counted.
    """
    parts = f"import {', '.join(pydrake_modules())}"
    comparisons = {
        "import_time": ("import vtbdrake", "import pydrake", 1.2, repeats),
        "import_time_names": (EVERYTHING, parts, 2.0, longer),
        "import_time_all": (EVERYTHING, "import pydrake.all", None, longer),
    }
    rows = []
    for name, (ours, theirs, goal, times) in comparisons.items():
        a, b = interleaved_values(partial(timed, ours), partial(timed, theirs), repeats=times, warm_up=warm_up)
        against = theirs if theirs != parts else "import of the modules of pydrake that vtbdrake loads"
        note = f"{ours}: {spread(a)}; {against}: {spread(b)}"
        rows.append(
            Benchmark(name=name, value=ratio(a, b), unit="1", goal=goal, better=LOWER, against=against, note=note)
        )
    return rows


def timed(statement: str) -> float:
    """Seconds that ``statement`` takes in a new interpreter."""
    return float(_run(_PROGRAM.format(statement)))


def pydrake_modules() -> list[str]:
    """The modules of pydrake that are loaded with all public names of vtbdrake."""
    printed = _run(f"{EVERYTHING}; import sys; print(sorted(m for m in sys.modules if m.split('.')[0] == 'pydrake'))")
    modules: list[str] = ast.literal_eval(printed)
    return [module for module in modules if not any(part.startswith("_") for part in module.split("."))]


def _run(program: str) -> str:
    # Run from the checkout's folder, `import vtbdrake` finds it before an installed one.
    return subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True).stdout
