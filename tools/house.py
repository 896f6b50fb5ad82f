"""The house in numbers: sizes, import circles, names with two meanings, functions and lines that are too long.

    python tools/house.py    print the tables; the exit code is 1 if a limit is broken

A limit stands beside each measure that has one. A name that a package lists counts as an import of the module that
defines it, and an import counts wherever it stands: in a function, and for types alone, too.
"""

import ast
import gc
import io
import re
import subprocess
import sys
import tokenize
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

ROOT = Path(__file__).resolve().parents[1]
# A folder is read as a whole: files of one folder may import each other, a few of them in a circle.
MAX_CIRCLE = 3
MAX_COMPLEXITY = 15
# One function may be more complex: `digest._node` is a flat `match`, a line for each kind of object.
COMPLEX = 1
MAX_NESTING = 4
MAX_FUNCTION_LINES = 60
MAX_COLUMNS = 120

Graph = dict[str, set[str]]  # module or folder -> what it imports


@dataclass(frozen=True)
class Import:
    """An import statement's name, and where it stands."""

    line: int
    name: str  # vtbdrake.testbed.Scenario
    place: str  # "module", "function" or "types"

    @property
    def waits(self) -> bool:
        """Return whether the importing module is loaded without the imported one."""
        return self.place != "module"


def module_name(path: Path) -> str:
    """Return the dotted name of a source file, of a package for its `__init__.py`."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(tree: ast.AST, module: str, is_package: bool) -> Iterator[Import]:
    """Yield every import in `tree`, the syntax tree of `module`, with absolute names."""

    def visit(node: ast.AST, place: str) -> Iterator[Import]:
        for child in ast.iter_child_nodes(node):
            match child:
                case ast.Import():
                    yield from (Import(child.lineno, alias.name, place) for alias in child.names)
                case ast.ImportFrom():
                    source = absolute(child)
                    yield from (Import(child.lineno, f"{source}.{alias.name}", place) for alias in child.names)
                case ast.If() if ast.unparse(child.test).endswith("TYPE_CHECKING"):
                    yield from visit(ast.Module(body=child.body, type_ignores=[]), "types")
                    yield from visit(ast.Module(body=child.orelse, type_ignores=[]), place)
                case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.Lambda() if place == "module":
                    yield from visit(child, "function")
                case _:
                    yield from visit(child, place)

    def absolute(node: ast.ImportFrom) -> str:
        if node.level == 0:
            return node.module or ""
        parts = module.split(".")
        base = parts[: len(parts) - node.level + is_package]
        return ".".join([*base, node.module] if node.module else base)

    return visit(tree, "module")


def import_lines(source: str) -> str:
    """Return the imports of a Cython module as Python."""
    statements = re.findall(r"^(?:from +\S+ +)?c?import +(?:\([^)]*\)|[^#\n]+)", source, re.MULTILINE)
    return "\n".join(statement.replace("cimport", "import") for statement in statements)


def source_files(*suffixes: str, folder: str = "vtbdrake") -> list[Path]:
    """Return the files that the repository keeps, without what lcm-gen makes."""
    files = (path for suffix in suffixes for path in (ROOT / folder).rglob(f"*{suffix}"))
    return sorted(path for path in files if not path.name.startswith("lcmt_"))


@cache
def syntax_trees(folder: str = "vtbdrake") -> dict[Path, ast.Module]:
    """Return the syntax tree of each Python file.

    The trees stay until the end: the garbage collector, which would look at their nodes while they are made and
    whenever they are read, leaves them out.
    """
    gc.disable()
    try:
        return {path: ast.parse(path.read_text("utf-8")) for path in source_files(".py", folder=folder)}
    finally:
        gc.freeze()
        gc.enable()


@cache
def syntax_nodes(tree: ast.AST) -> list[ast.AST]:
    """Return all nodes of a syntax tree; several measures read each tree."""
    return list(ast.walk(tree))


# ----- import circles


@cache
def import_graph() -> Graph:
    """Return the imports between the files of vtbdrake; a name that a package lists leads to its definition."""
    trees: dict[str, ast.AST] = {module_name(path): tree for path, tree in syntax_trees().items()}
    trees |= {module_name(path): ast.parse(import_lines(path.read_text("utf-8"))) for path in source_files(".pyx")}
    packages = {module_name(path): path for path in source_files("__init__.py")}
    listed = {package: ast.parse(stub_of(path)) for package, path in packages.items()}
    exports = {
        f"{package}.{entry.name.rpartition('.')[2]}": entry.name
        for package, tree in listed.items()
        for entry in imports(tree, package, True)
    }

    def home(name: str) -> str:
        """Return the module that a dotted name stands in."""
        for _ in range(5):  # a package lists what a package lists
            if name in trees or name not in exports:
                break
            name = exports[name]
        while name and name not in trees:
            name = name.rpartition(".")[0]
        return name

    graph: Graph = {}
    for module, tree in trees.items():
        names = (home(entry.name) for entry in imports(tree, module, module in packages))
        graph[module] = {name for name in names if name not in ("", module, "vtbdrake")}
    return graph


def stub_of(path: Path) -> str:
    """Return the text that lists a package's names: its `__init__.pyi`, or its `__init__.py`."""
    stub = path.with_suffix(".pyi")
    return (stub if stub.exists() else path).read_text("utf-8")


def circles(graph: Graph) -> list[list[str]]:
    """Return the groups of nodes that reach each other, the largest first."""
    names = sorted(graph.keys() | {target for targets in graph.values() for target in targets})
    number = {name: index for index, name in enumerate(names)}
    edges = [(number[name], number[target]) for name, targets in graph.items() for target in targets - {name}]
    rows, columns = np.array(edges, int).reshape(-1, 2).T
    links = coo_array((np.ones(len(edges)), (rows, columns)), shape=(len(names), len(names)))
    _, groups = connected_components(links, directed=True, connection="strong")
    members = defaultdict(list)
    for name, group in zip(names, groups, strict=True):
        members[group].append(name)
    return sorted((group for group in members.values() if len(group) > 1), key=len, reverse=True)


def largest(groups: list[list[str]]) -> int:
    """Return the size of the largest circle, 0 if there is none."""
    return len(groups[0]) if groups else 0


def layer(module: str) -> str:
    """Return the folder of vtbdrake that a module stands in."""
    return ".".join(module.split(".")[:2])


def layer_graph(graph: Graph) -> Graph:
    """Return the imports between the folders of vtbdrake."""
    layers: Graph = defaultdict(set)
    for module, targets in graph.items():
        if "." in module:  # vtbdrake itself lists the names of all
            layers[layer(module)] |= {layer(target) for target in targets} - {layer(module)}
    return layers


def within_layers(graph: Graph) -> Graph:
    """Return the imports between files of the same folder of vtbdrake."""
    return {
        module: {target for target in targets if layer(target) == layer(module)} for module, targets in graph.items()
    }


# ----- names


def homonyms(*, public: bool = True) -> dict[str, list[str]]:
    """Return the names of several classes, outside functions and classes, with the modules of each."""
    places = defaultdict(list)
    for path in source_files(".py", ".pyx"):
        for name in re.findall(r"^(?:cdef )?class (\w+)", path.read_text("utf-8"), re.MULTILINE):
            if name.startswith("_") != public:
                places[name].append(module_name(path))
    return {name: modules for name, modules in sorted(places.items()) if len(modules) > 1}


def repeated_basenames() -> dict[str, list[str]]:
    """Return the file names that occur in several folders, without those that Python gives."""
    places = defaultdict(list)
    for path in source_files(".py", ".pyx"):
        if path.stem not in ("__init__", "__main__"):
            places[path.stem].append(module_name(path))
    return {name: modules for name, modules in sorted(places.items()) if len(modules) > 1}


def packed_constants(tree: ast.Module) -> list[int]:
    """Return the lines outside functions that bind several constants by position."""
    bodies = [tree.body, *(node.body for node in syntax_nodes(tree) if isinstance(node, ast.ClassDef))]
    return [
        node.lineno
        for body in bodies
        for node in body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Tuple) and all(ast.unparse(name).isupper() for name in target.elts)
    ]


def packed_constant_lines() -> list[str]:
    """Return every such line of the package and its testbeds."""
    return [
        f"{path.relative_to(ROOT)}:{line}"
        for folder in ("vtbdrake", "diagrams")
        for path, tree in syntax_trees(folder).items()
        for line in packed_constants(tree)
    ]


# ----- functions and lines


def function_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Return the number of lines of a function without its docstring, and the docstrings of what it defines."""
    lines = (function.end_lineno or 0) - function.lineno + 1
    for node in ast.walk(function):
        match node:
            case ast.ClassDef() | ast.FunctionDef() | ast.AsyncFunctionDef() if ast.get_docstring(node, clean=False):
                docstring = node.body[0]
                lines -= (docstring.end_lineno or 0) - docstring.lineno + 1
    return lines


def long_functions(trees: dict[Path, ast.Module]) -> list[str]:
    """Return the functions that are too long to be read at once, the longest first."""
    lengths = [
        (function_lines(node), f"{path.relative_to(ROOT)}:{node.lineno} {node.name}")
        for path, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    too_long = sorted((entry for entry in lengths if entry[0] > MAX_FUNCTION_LINES), reverse=True)
    return [f"{place} ({length} lines)" for length, place in too_long]


def ruff(rule: str, *settings: str) -> list[str]:
    """Return the places that a rule of ruff finds in vtbdrake, whatever its comments allow."""
    options = [option for setting in settings for option in ("--config", setting)]
    command = [sys.executable, "-m", "ruff", "check", "--isolated", "--preview", "--ignore-noqa", "--exit-zero"]
    command += ["--quiet", "--output-format", "concise", "--select", rule, *options, "vtbdrake"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def long_lines() -> list[str]:
    """Return the lines of programs, styles and pages that are too long, without blocks of code in pages."""
    places = []
    for path in tracked("*.py", "*.pyx", "*.js", "*.css", "*.md", ":!*/vendor/*"):
        in_code = False
        for number, line in enumerate((ROOT / path).read_text("utf-8").splitlines(), 1):
            if path.endswith(".md") and line.lstrip().startswith("```"):
                in_code = not in_code
            if not in_code and len(line) > MAX_COLUMNS:
                places.append(f"{path}:{number}")
    return places


def tracked(*patterns: str) -> list[str]:
    """Return the files that git keeps."""
    command = ["git", "ls-files", "--", *patterns]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return [name for name in done.stdout.splitlines() if not (ROOT / name).is_symlink() and (ROOT / name).exists()]


def code_lines(source: str) -> int:
    """Return the number of lines without empty ones, comments and docstrings; also of Cython."""
    ends = {tokenize.NEWLINE, tokenize.NL, tokenize.INDENT, tokenize.DEDENT, tokenize.COMMENT, tokenize.ENCODING}
    lines: set[int] = set()
    starts_statement = True
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in ends and not (starts_statement and token.type == tokenize.STRING):
            lines.update(range(token.start[0], token.end[0] + 1))
        if token.type not in (tokenize.COMMENT, tokenize.NL):
            starts_statement = token.type in ends
    return len(lines)


# ----- the tables


@dataclass
class Line:
    """A measure, its limit if it has one, and the places that it counts."""

    measure: str
    count: int
    limit: int | None = None
    places: Iterable[str] = field(default_factory=list)

    @property
    def broken(self) -> bool:
        """Return whether the count is above the limit."""
        return self.limit is not None and self.count > self.limit


def places_of(names: dict[str, list[str]]) -> list[str]:
    """Return a line per name."""
    return [f"{name}: {', '.join(modules)}" for name, modules in names.items()]


def measures() -> Iterator[Line]:
    """Yield the lines of the table."""
    trees = syntax_trees()
    graph = import_graph()
    within = circles(within_layers(graph))
    between = circles(layer_graph(graph))
    whole = circles(graph)
    yield Line("files in the largest circle of vtbdrake", largest(whole), MAX_CIRCLE)
    yield Line("files in the largest circle within a folder", largest(within), MAX_CIRCLE, map(str, within))
    yield Line("folders in the largest circle between folders", largest(between), 0, map(str, between))
    public = homonyms()
    yield Line("names of several public classes", len(public), 0, places_of(public))
    private = homonyms(public=False)
    yield Line("names of several private classes", len(private), 0, places_of(private))
    basenames = repeated_basenames()
    yield Line("file names in several folders", len(basenames), None, places_of(basenames))
    packed = packed_constant_lines()
    yield Line("lines that bind several constants by position", len(packed), 0, packed)
    nested = ruff("PLR1702", f"lint.pylint.max-nested-blocks={MAX_NESTING}")
    yield Line(f"blocks nested deeper than {MAX_NESTING}", len(nested), 0, nested)
    branching = ruff("C901", f"lint.mccabe.max-complexity={MAX_COMPLEXITY}")
    yield Line(f"functions of a complexity (McCabe) above {MAX_COMPLEXITY}", len(branching), COMPLEX, branching)
    functions = long_functions(trees)
    yield Line(f"functions of more than {MAX_FUNCTION_LINES} lines", len(functions), 0, functions)
    columns = long_lines()
    files = Counter(place.rpartition(":")[0] for place in columns)
    yield Line(f"lines longer than {MAX_COLUMNS} columns", len(columns), None, [f"{n} {f}" for f, n in files.items()])


def folder_table(depth: int = 3) -> str:
    """Return lines, classes and the largest circle of each folder."""
    sizes: dict[str, Counter[str]] = defaultdict(Counter)
    for path in source_files(".py", ".pyx"):
        text = path.read_text("utf-8")
        folder = "/".join(path.parent.relative_to(ROOT).parts[:depth])
        count = {"files": 1, "lines": text.count("\n"), "code": code_lines(text)}
        count["classes"] = len(re.findall(r"^ *(?:cdef )?class \w", text, re.MULTILINE))
        sizes[folder].update(count)
        sizes["all"].update(count)
    columns = ("files", "lines", "code", "classes")
    rows = [("folder", *columns), *((name, *(str(size[c]) for c in columns)) for name, size in sorted(sizes.items()))]
    return "\n".join(f"{row[0]:40}" + "".join(f"{cell:>9}" for cell in row[1:]) for row in rows)


def main() -> int:
    """Print the tables."""
    print(folder_table(), end="\n\n")
    lines = list(measures())
    for line in lines:
        print(f"{line.measure:60}{line.count:6}  {'' if line.limit is None else f'limit {line.limit}'}")
        if "-v" in sys.argv or line.broken:
            print(*(f"    {place}" for place in line.places), sep="\n")
    return any(line.broken for line in lines)


if __name__ == "__main__":
    sys.exit(main())
