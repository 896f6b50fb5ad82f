"""Imports inside vtbdrake point one way, and importing it stays light."""

import ast
import subprocess
import sys

import pytest

from tools.house import (
    MAX_CIRCLE,
    ROOT,
    circles,
    import_graph,
    import_lines,
    imports,
    layer_graph,
    module_name,
    source_files,
    syntax_trees,
    within_layers,
)
from vtbdrake import upper_layers

pytestmark = pytest.mark.one_python

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
    "station": {"state", "testbed", "components", "control", "lcm", "monitoring", "deployment"},
    "components": {"state"},
    "compiled": {"state", "testbed", "components"},
    "fmi": {"state", "testbed", "components", "compiled"},
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
BELOW["drake_workarounds"] = {"state"}
for _layers in BELOW.values():
    _layers |= {"common", "drake_workarounds"}
BELOW["state"] = {"common"}
BELOW["common"] = set()
BELOW["project"] = {"state", "testbed", "components", "station", "common"}
BELOW["visualization"] = set(BELOW)
BELOW["campaigns"] = {"state", "testbed", "rollout", "optimization", "visualization", "common"}
BELOW["environments"] = {"state", "testbed", "rollout", "optimization", "compiled", "common", "drake_workarounds"}
BELOW["testing"] = set(BELOW)
BELOW["web"] = set(BELOW)
BELOW["cli"] = set(BELOW)
BELOW["__main__"] = {"cli"}
TOP = {"visualization", "web", "testing", "cli"}

# Methods of these find the layer above through the table `vtbdrake/upper_layers.pyi`.
DELEGATE = {"testbed", "optimization", "reasoning", "calibration"}
TABLE = "upper_layers"

OUTSIDE = {"vtbdrake_diagrams", "diagrams", "benchmarks", "tests"}

HEAVY = {"matplotlib.pyplot", "pandas", "casadi", "lcm", "tqdm.notebook", "cv2", "optuna", "distributed"}
HEAVY |= {f"scipy.{part}" for part in ("linalg", "special", "spatial", "optimize", "interpolate", "stats")}


def violations(tree: ast.AST, module: str, is_package: bool = False) -> list[str]:
    """The imports in `tree`, the syntax tree of `module` (such as `vtbdrake.rollout.executor`), that break a layer."""
    parts = module.split(".")
    is_root = parts == ["vtbdrake"]
    layer = parts[1] if len(parts) > 1 else ""
    if not is_root and layer not in {*BELOW, TABLE}:
        return [f"{module}: '{layer}' is no layer; give it a place in BELOW"]
    found = []
    for entry in imports(tree, module, is_package):
        line, name = entry.line, entry.name
        top, _, rest = name.partition(".")
        target = rest.partition(".")[0]
        if top in OUTSIDE:
            found.append(f"{module}:{line}: imports {name}, which is not part of the package")
        elif top != "vtbdrake" or is_root or target == layer:
            continue
        elif target == TABLE:
            if layer not in DELEGATE:
                found.append(f"{module}:{line}: {layer} must not hand over to upper layers")
        elif target not in BELOW:
            if layer not in TOP:
                found.append(f"{module}:{line}: imports {name} from the root, which imports every layer")
        elif target not in BELOW[layer]:
            found.append(f"{module}:{line}: {layer} must not import {target}")
    return found


def test_imports_point_one_way() -> None:
    found = []
    for path, tree in syntax_trees().items():
        found += violations(tree, module_name(path), path.stem == "__init__")
    assert not found, "\n".join(found)


def test_imports_of_compiled_modules_point_one_way() -> None:
    found = []
    for path in source_files(".pyx"):
        found += violations(ast.parse(import_lines(path.read_text("utf-8"))), module_name(path))
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("vtbdrake.state.a", "import vtbdrake.testbed"),
        ("vtbdrake.testbed.a", "from vtbdrake.rollout import Rollout"),
        ("vtbdrake.testbed.a", "from vtbdrake.components.sensors import Imu"),
        ("vtbdrake.testbed.a", "from vtbdrake.deployment import deploy"),
        ("vtbdrake.testbed.a", "def deploy(self):\n    from vtbdrake.deployment import deploy"),
        ("vtbdrake.optimization.a", "if TYPE_CHECKING:\n    from vtbdrake.visualization import Figure"),
        ("vtbdrake.rollout.a", "def plot(self):\n    from vtbdrake.visualization import plot_rollout"),
        ("vtbdrake.control.a", "from vtbdrake import upper_layers"),
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
    assert len(violations(ast.parse(source), module)) == 1


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("vtbdrake.rollout.a", "from vtbdrake.testbed import Testbed\nfrom .b import c\nfrom . import d\nimport numpy"),
        ("vtbdrake.testbed.a", "from vtbdrake import upper_layers"),
        ("vtbdrake.optimization.a", "if TYPE_CHECKING:\n    from vtbdrake.upper_layers import Scene"),
        ("vtbdrake.calibration.a", "from ..rollout import Rollout"),
        ("vtbdrake.cli.a", "import vtbdrake as vtb\nfrom vtbdrake import reasoning, control"),
        ("vtbdrake", "from vtbdrake.cli import main"),
    ],
)
def test_import_along_the_layers_passes(module: str, source: str) -> None:
    assert violations(ast.parse(source), module) == []


def test_relative_import_in_a_package_starts_at_the_package() -> None:
    assert violations(ast.parse("from .b import c"), "vtbdrake.rollout", is_package=True) == []
    assert len(violations(ast.parse("from ..cli import main"), "vtbdrake.rollout", is_package=True)) == 1


def test_table_names_what_is_there() -> None:
    for name in upper_layers.__all__:
        assert getattr(upper_layers, name).__name__ == name


def test_circles_are_found() -> None:
    graph = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": {"e"}, "e": {"d"}, "f": {"a"}}
    assert circles(graph) == [["a", "b", "c"], ["d", "e"]]
    assert circles({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []


def test_imports_in_functions_and_for_types_count() -> None:
    source = "import a\nif TYPE_CHECKING:\n    import b\ndef f():\n    from .c import d\n"
    places = {entry.name: entry.place for entry in imports(ast.parse(source), "vtbdrake.e", False)}
    assert places == {"a": "module", "b": "types", "vtbdrake.c.d": "function"}


def test_graph_leads_to_the_module_that_defines_a_name() -> None:
    graph = import_graph()
    assert "vtbdrake.testbed.scenario" in graph["vtbdrake.rollout.task"]
    assert "vtbdrake.web.live.viewer" in graph["vtbdrake.cli.view"]


def test_folders_import_each_other_in_no_circle() -> None:
    assert circles(layer_graph(import_graph())) == []


def test_few_files_of_a_folder_import_each_other_in_a_circle() -> None:
    found = [group for group in circles(within_layers(import_graph())) if len(group) > MAX_CIRCLE]
    assert not found, "\n".join(map(str, found))


@pytest.mark.slow_cases
@pytest.mark.parametrize("use", ["vtbdrake", "vtbdrake.Problem, vtbdrake.Parameter, vtbdrake.Quality, vtbdrake.Study"])
def test_import_loads_nothing_heavy(use: str) -> None:
    code = f"import sys, vtbdrake; {use}; print(*sorted({HEAVY!r} & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.split() == []


@pytest.mark.slow
def test_calibration_loads_what_is_slow_to_load_when_it_is_used() -> None:
    """scipy.signal and scipy.stats take longer to load than all the rest."""
    slow = {"scipy.signal", "scipy.stats"}
    code = f"import sys, vtbdrake.calibration.calibration; print(*sorted({slow!r} & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.split() == []
