"""Imports inside vtbdrake point one way, and importing it stays light."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.one_python

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "vtbdrake"

# What each layer may import besides itself:
# state <- testbed <- rollout <- optimization <- reasoning; testbed <- control <- lcm <- recording, monitoring, machine.
BELOW: dict[str, set[str]] = {
    "state": set(),
    "testbed": {"state"},
    "rollout": {"state", "testbed", "compiled"},
    "optimization": {"state", "testbed", "rollout"},
    "reasoning": {"state", "testbed", "rollout", "optimization", "compiled"},
    "control": {"state", "testbed"},
    "lcm": {"state", "testbed", "control"},
    "recording": {"state", "testbed", "control", "lcm"},
    "monitoring": {"state", "testbed", "control", "lcm"},
    "machine": {"state", "testbed", "control", "lcm"},
    "deployment": {"state", "testbed", "control", "lcm", "recording", "monitoring"},
    "station": {"state", "testbed", "control", "lcm", "monitoring", "deployment"},
    "components": {"state"},
    "compiled": {"state", "testbed", "components"},
    "calibration": {
        "state",
        "testbed",
        "rollout",
        "optimization",
        "control",
        "recording",
        "monitoring",
        "components",
        "lcm",
        "machine",
    },
}
# Modules that need neither Drake nor the layers: how arguments are checked, how other processes start, how objects
# travel to them, when the names of a package are imported, what a cache keeps, arrays, splines, laser scans, and where
# a model is valid.
for _layers in BELOW.values():
    _layers.update({"argument_checks", "arrays", "child_process", "closing", "failures", "frames", "lazy"})
    _layers.update({"lru", "pickling", "scan", "settings", "spline", "streams", "validity_domain"})
BELOW["spline"] = {"argument_checks", "arrays", "spline_kernel"}
BELOW["spline_kernel"] = {"state"}
BELOW["scan"] = {"arrays"}
BELOW["arrays"] = set()
BELOW["closing"] = set()
BELOW["validity_domain"] = {"argument_checks", "arrays"}
BELOW["pickling"] = set()
BELOW["streams"] = set()
BELOW["frames"] = {"streams"}
BELOW["child_process"] = {"pickling"}
BELOW["argument_checks"] = set()
BELOW["settings"] = set()
BELOW["failures"] = set()
BELOW["lazy"] = set()
BELOW["lru"] = set()
BELOW["drake_version"] = set()
BELOW["state"].add("drake_version")
BELOW["child_process"].add("drake_version")
BELOW["project"] = {"state", "testbed", "components", "station", "failures"}
BELOW["visualization"] = set(BELOW)
BELOW["web"] = set(BELOW)
BELOW["testing"] = set(BELOW)
BELOW["cli"] = set(BELOW)
BELOW["__main__"] = {"cli"}
TOP = {"visualization", "web", "testing", "cli"}

# A method may delegate to an upper layer, which it imports when it is called: results plot and show themselves by
# `visualization`, a scenario is deployed by `deployment`, what was calibrated is drawn by `calibration`; a testbed is
# compiled by `compiled`, and shown by `web`, as a study is; `web` lets `testing` save a course as a test.
MAY_DELEGATE: dict[str, set[str]] = {
    "testbed": {"calibration", "compiled", "deployment", "visualization", "web"},
    "web": {"testing"},
    "optimization": {"visualization", "web"},
    **{layer: {"visualization"} for layer in ("rollout", "reasoning", "calibration")},
}

OUTSIDE = {"vtbdrake_diagrams", "diagrams", "benchmarks", "tests"}

HEAVY = {"matplotlib.pyplot", "pandas", "casadi", "lcm", "tqdm.notebook", "cv2", "optuna", "distributed", "scipy.stats"}


def imported_modules(tree: ast.Module, module: str, is_package: bool) -> Iterator[tuple[int, str, bool]]:
    """Line, dotted name and whether it waits (for a call, or for ever: a type checker) of every import in `tree`."""

    def visit(node: ast.AST, lazy: bool) -> Iterator[tuple[int, str, bool]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Import):
                yield from ((child.lineno, alias.name, lazy) for alias in child.names)
            elif isinstance(child, ast.ImportFrom):
                source = absolute(child)
                yield from ((child.lineno, f"{source}.{alias.name}", lazy) for alias in child.names)
            elif isinstance(child, ast.If) and ast.unparse(child.test).endswith("TYPE_CHECKING"):
                yield from visit(ast.Module(body=child.body, type_ignores=[]), True)
                yield from visit(ast.Module(body=child.orelse, type_ignores=[]), lazy)
            else:
                yield from visit(child, lazy or isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda))

    def absolute(node: ast.ImportFrom) -> str:
        if node.level == 0:
            return node.module or ""
        parts = module.split(".")
        base = parts[: len(parts) - node.level + is_package]
        return ".".join([*base, node.module] if node.module else base)

    return visit(tree, False)


def violations(source: str, module: str, is_package: bool = False) -> list[str]:
    """The imports in `source`, the text of `module` (such as `vtbdrake.rollout.executor`), that break a layer."""
    parts = module.split(".")
    is_root = parts == ["vtbdrake"]
    layer = parts[1] if len(parts) > 1 else ""
    if not is_root and layer not in BELOW:
        return [f"{module}: '{layer}' is no layer; give it a place in BELOW"]
    found = []
    for line, name, lazy in imported_modules(ast.parse(source), module, is_package):
        top, _, rest = name.partition(".")
        target = rest.partition(".")[0]
        if top in OUTSIDE:
            found.append(f"{module}:{line}: imports {name}, which is not part of the package")
        elif top != "vtbdrake" or is_root or target == layer:
            continue
        elif target not in BELOW:
            if layer not in TOP:
                found.append(f"{module}:{line}: imports {name} from the root, which imports every layer")
        elif target not in BELOW[layer] and not (lazy and target in MAY_DELEGATE.get(layer, ())):
            found.append(f"{module}:{line}: {layer} must not import {target}")
    return found


def test_imports_point_one_way() -> None:
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        is_package = parts[-1] == "__init__"
        module = ".".join(parts[:-1] if is_package else parts)
        found += violations(path.read_text(encoding="utf-8"), module, is_package)
    assert not found, "\n".join(found)


def test_imports_of_compiled_modules_point_one_way() -> None:
    found = []
    for path in sorted(PACKAGE.rglob("*.pyx")):
        imports = re.findall(r"^(?:from +\S+ +)?c?import +(?:\([^)]*\)|[^#\n]+)", path.read_text("utf-8"), re.MULTILINE)
        source = "\n".join(line.replace("cimport", "import") for line in imports)
        found += violations(source, ".".join(path.relative_to(ROOT).with_suffix("").parts))
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("vtbdrake.state.a", "import vtbdrake.testbed"),
        ("vtbdrake.testbed.a", "from vtbdrake.rollout import Rollout"),
        ("vtbdrake.testbed.a", "from vtbdrake.components.sensors import Imu"),
        ("vtbdrake.testbed.a", "from vtbdrake.deployment import deploy"),
        ("vtbdrake.control.a", "def f():\n    from vtbdrake.deployment import deploy"),
        ("vtbdrake.rollout.a", "from vtbdrake import optimization"),
        ("vtbdrake.rollout.a", "from ..optimization import Problem"),
        ("vtbdrake.rollout.a", "from .. import cli"),
        ("vtbdrake.rollout.a", "from vtbdrake.visualization import plot"),
        ("vtbdrake.rollout.a", "class A:\n    from vtbdrake.visualization import plot"),
        ("vtbdrake.control.a", "from vtbdrake.reasoning import Reasoner"),
        ("vtbdrake.control.a", "def f():\n    from vtbdrake.rollout import Rollout"),
        ("vtbdrake.reasoning.a", "try:\n    import vtbdrake.control.runtime\nexcept ImportError:\n    raise"),
        ("vtbdrake.components.a", "import vtbdrake.testbed as t"),
        ("vtbdrake.components.a", "if TYPE_CHECKING:\n    from vtbdrake.testbed import Testbed"),
        ("vtbdrake.visualization.a", "def f():\n    import vtbdrake.cli"),
        ("vtbdrake.optimization.a", "import vtbdrake as vtb"),
        ("vtbdrake.optimization.a", "from vtbdrake import Problem"),
        ("vtbdrake.cli.a", "def f():\n    from vtbdrake_diagrams.space_climber import SpaceClimberScenario"),
        ("vtbdrake", "import vtbdrake_diagrams"),
        ("vtbdrake.misplaced.a", ""),
    ],
)
def test_import_against_the_layers_is_found(module: str, source: str) -> None:
    assert len(violations(source, module)) == 1


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("vtbdrake.rollout.a", "from vtbdrake.testbed import Testbed\nfrom .b import c\nfrom . import d\nimport numpy"),
        ("vtbdrake.rollout.a", "def plot(self):\n    from vtbdrake.visualization import plot_rollout"),
        ("vtbdrake.testbed.a", "def deploy(self):\n    from vtbdrake.deployment import deploy"),
        ("vtbdrake.optimization.a", "if TYPE_CHECKING:\n    from vtbdrake.visualization import Figure"),
        ("vtbdrake.calibration.a", "from ..rollout import Rollout"),
        ("vtbdrake.cli.a", "import vtbdrake as vtb\nfrom vtbdrake import reasoning, control"),
        ("vtbdrake", "from vtbdrake.cli import main"),
    ],
)
def test_import_along_the_layers_passes(module: str, source: str) -> None:
    assert violations(source, module) == []


def test_relative_import_in_a_package_starts_at_the_package() -> None:
    assert violations("from .b import c", "vtbdrake.rollout", is_package=True) == []
    assert len(violations("from ..cli import main", "vtbdrake.rollout", is_package=True)) == 1


@pytest.mark.parametrize("use", ["vtbdrake", "vtbdrake.Problem, vtbdrake.Parameter, vtbdrake.Quality, vtbdrake.Study"])
def test_import_loads_nothing_heavy(use: str) -> None:
    code = f"import sys, vtbdrake; {use}; print(*sorted({HEAVY!r} & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.split() == []
