"""Names and sentences say what a thing is: vague words and pointing phrases are found, arguments are described."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

from tools.house import (
    ROOT,
    function_lines,
    homonyms,
    packed_constant_lines,
    packed_constants,
    source_files,
    syntax_nodes,
    syntax_trees,
)

pytestmark = pytest.mark.one_python

# Words that stand where a type or a role should, as whole names. In a line or two they may be the best ones.
VAGUE = {"found", "known", "one", "own", "given", "chosen", "kept"}
VAGUE |= {"seen", "what", "others", "asked", "wanted", "told", "held"}
BUDGET = 20


def bound_names(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line and name of everything that a module binds: variables, attributes, arguments, functions, classes."""
    for node in syntax_nodes(tree):
        match node:
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()) | ast.arg(arg=name):
                yield node.lineno, name
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield node.lineno, name


def vague_names(tree: ast.AST) -> list[tuple[int, str]]:
    return [(line, name) for line, name in bound_names(tree) if name.strip("_") in VAGUE]


def test_packed_constants_are_found():
    source = """
A, _B = 1, 2
class Limits:
    LOWER, UPPER = ends()
    names = X = 3
def f():
    A, B = matrices()
"""
    assert packed_constants(ast.parse(source)) == [2, 4]


def test_constants_stand_alone():
    places = packed_constant_lines()
    assert not places, "\n".join(places)


def test_length_of_a_function_is_without_its_docstring():
    described, silent, outer = ast.parse("""
def described(
    a, b
):
    '''Return the sum.

    It is computed.
    '''
    return a + b
def silent():
    a = '''a
    b'''
    return a
def outer():
    class Inner:
        '''An inner class.

        It has a docstring.
        '''
    return Inner
""").body
    assert [function_lines(each) for each in (described, silent, outer)] == [4, 4, 3]


def test_a_class_name_has_one_meaning():
    assert homonyms() == {}
    assert homonyms(public=False) == {}


def test_vague_names_are_found_wherever_they_are_bound():
    source = """
def found(known, *, given=None):
    one: int = 1
    self._own = [what for what in known]
    with open(one) as held, open(given) as file:
        pass
    for others, name in file:
        founder = one
"""
    names = {name for _, name in vague_names(ast.parse(source))}
    assert names == {"found", "known", "given", "one", "_own", "what", "held", "others"}


def test_few_names_say_nothing_of_what_they_name():
    places = [
        f"{path.relative_to(ROOT)}:{line} {name}"
        for folder in ("vtbdrake", "diagrams")
        for path, tree in syntax_trees(folder).items()
        for line, name in vague_names(tree)
    ]
    assert len(places) <= BUDGET, "\n".join(places)


# A reader has to look back for what these stand for: name the thing instead.
POINTING = re.compile(r"\b(?:that|those) of\b|\bso many\b|\bof which\b|^Of [a-z]+\b|(?<=[.:] )Of [a-z]+\b")
POINTING_ANYWHERE = re.compile(r"that of|those of|so many|of which|\bOf [a-z]")
# A docstring says the type first: "Return the indices of ...", not "Return which ...".
UNTYPED = re.compile(r"Returns? (?:all that|how|that|what|when|where|which|who|why)\b")
SOURCES = ("vtbdrake", "diagrams", "benchmarks", "tests", "tools")
FILES = {
    folder: [path for path in source_files(".py", folder=folder) if path != Path(__file__)] for folder in SOURCES
} | {"docs": [*ROOT.glob("*.md"), *sorted((ROOT / "docs").rglob("*.md"))]}


def prose(source: str) -> Iterator[tuple[int, str]]:
    """Yield the lines of comments and texts in a module, with their numbers."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string.lstrip("# ")
        elif token.type == tokenize.STRING:
            for number, line in enumerate(token.string.splitlines(), token.start[0]):
                yield number, line.strip(" rf\"'")


def pointing(path: Path) -> list[str]:
    """Return the places in a file that have a pointing phrase."""
    text = path.read_text("utf-8")
    if not POINTING_ANYWHERE.search(text):
        return []
    lines = prose(text) if path.suffix == ".py" else enumerate(text.splitlines(), 1)
    return [f"{path.relative_to(ROOT)}:{number}: {line}" for number, line in lines if POINTING.search(line)]


def docstrings(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line and docstring of everything in a module that has one."""
    for node in syntax_nodes(tree):
        is_documented = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        if is_documented and (text := ast.get_docstring(node)):
            yield getattr(node, "lineno", 1), text


def test_pointing_phrases_are_found():
    source = """# Of a table: the column
def f():
    'The errors are those of g. Of two values the last counts.'
    return "a part of the whole; that offer"
"""
    lines = [number for number, line in prose(source) if POINTING.search(line)]
    assert lines == [1, 3]


@pytest.mark.parametrize("folder", FILES)
def test_sentences_name_what_they_mean(folder):
    places = [place for path in FILES[folder] for place in pointing(path)]
    assert not places, "name the thing instead of pointing at it:\n" + "\n".join(places)


@pytest.mark.parametrize(("folder", "pattern"), [("vtbdrake", UNTYPED), ("tests", re.compile(r"(?:What|How)\b"))])
def test_docstrings_say_the_type_first_and_tests_state_facts(folder, pattern):
    places = [
        f"{path.relative_to(ROOT)}:{line}: {text.splitlines()[0]}"
        for path, tree in syntax_trees(folder).items()
        for line, text in docstrings(tree)
        if pattern.match(text)
    ]
    assert not places, "\n".join(places)


# One entry of the section of arguments: a name, or several that are described together.
DESCRIBED = re.compile(r"^ {4}(\*{0,2}\w+(?:, \*{0,2}\w+)*):", re.MULTILINE)
SECTION = re.compile(r"^Args:\n((?: .*\n?|\n)*)", re.MULTILINE)


def is_command(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Return whether a function is a command of click, whose options describe themselves."""
    decorators = (d.func if isinstance(d, ast.Call) else d for d in function.decorator_list)
    return any(ast.unparse(decorator).endswith((".command", ".group")) for decorator in decorators)


def argument_names(function: ast.FunctionDef | ast.AsyncFunctionDef, *, is_method: bool) -> list[str]:
    """Return the names of a function's arguments that a caller gives."""
    given = function.args
    names = [argument.arg for argument in (*given.posonlyargs, *given.args)]
    if is_method and "staticmethod" not in map(ast.unparse, function.decorator_list):
        names = names[1:]
    more = (given.vararg, *given.kwonlyargs, given.kwarg)
    return [name for name in (*names, *(each.arg for each in more if each)) if not name.startswith("_")]


def misdescribed(body: list[ast.stmt], *, is_method: bool = False) -> Iterator[tuple[int, str]]:
    """Yield line and name of public functions whose two or more arguments are not those that their docstring describes.

    A method without a docstring is skipped: it inherits one. So is an overload: the function itself has one.

    Args:
        body: The statements of a module, or of a class.
        is_method: Whether they are a class's.
    """
    for node in body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from misdescribed(node.body, is_method=True)
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not node.name.startswith("_"):
            names, text = argument_names(node, is_method=is_method), ast.get_docstring(node)
            is_overload = any(isinstance(each, ast.Name) and each.id == "overload" for each in node.decorator_list)
            if len(names) < 2 or is_command(node) or is_overload or (is_method and text is None):
                continue
            section = SECTION.search(text or "")
            entries = DESCRIBED.findall(section[1]) if section else []
            if sorted(names) != sorted(name.strip("*") for entry in entries for name in entry.split(", ")):
                yield node.lineno, node.name


# Fields and arguments of constructors may stand among a class's attributes, too.
CLASS_SECTION = re.compile(r"^(?:Args|Attributes):\n((?: .*\n?|\n)*)", re.MULTILINE)


def constructor_of(kind: ast.ClassDef) -> ast.FunctionDef | None:
    return next((f for f in kind.body if isinstance(f, ast.FunctionDef) and f.name == "__init__"), None)


def constructor_arguments(kind: ast.ClassDef) -> list[str]:
    """Return the names that a class is made with; fields that a `setting` describes are left out."""
    if constructor := constructor_of(kind):
        return argument_names(constructor, is_method=True)
    decorators = [ast.unparse(decorator) for decorator in kind.decorator_list]
    if not (any(d.startswith("dataclass") for d in decorators) or "NamedTuple" in map(ast.unparse, kind.bases)):
        return []
    items = [item for item in kind.body if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name)]
    texts = {
        ast.unparse(item.target): (ast.unparse(item.annotation), ast.unparse(item.value or item)) for item in items
    }
    return [
        name
        for name, (annotation, value) in texts.items()
        if not name.startswith("_")
        and not annotation.startswith("ClassVar")
        and not (value.startswith("setting(") or "init=False" in value)
    ]


def described_names(kind: ast.ClassDef, classes: dict[str, ast.ClassDef]) -> set[str]:
    """Return the names that a class, its constructor, or a base among ``classes`` describes."""
    texts = [ast.get_docstring(kind) or ""]
    if constructor := constructor_of(kind):
        texts.append(ast.get_docstring(constructor) or "")
    entries = [e for text in texts for section in CLASS_SECTION.findall(text) for e in DESCRIBED.findall(section)]
    names = {name.strip("*") for entry in entries for name in entry.split(", ")}
    bases = {re.sub(r"\[.*", "", ast.unparse(base)).rpartition(".")[2] for base in kind.bases}
    return names.union(*(described_names(classes[base], classes) for base in bases & classes.keys()))


def undescribed(classes: dict[str, ast.ClassDef]) -> Iterator[tuple[str, list[str]]]:
    """Yield the public classes with two or more arguments, or fields, that are not all described, with the others."""
    for name, kind in classes.items():
        names = [] if name.startswith("_") else constructor_arguments(kind)
        missing = sorted(set(names) - described_names(kind, classes))
        if len(names) > 1 and missing:
            yield name, missing


def classes_in(*trees: ast.Module) -> dict[str, ast.ClassDef]:
    return {node.name: node for tree in trees for node in syntax_nodes(tree) if isinstance(node, ast.ClassDef)}


def test_undescribed_constructors_are_found():
    source = """
class Base:
    '''A base.

    Args:
        a, b: Numbers.
    '''
    def __init__(self, a, *, b): pass
class Inherits(Base):
    def __init__(self, a, b): pass
class Lacks(package.Base[int]):
    def __init__(self, a, c): pass
class InConstructor:
    def __init__(self, a, b):
        '''Make it.

        Args:
            a: A number.
            b: Another.
        '''
@dataclass(frozen=True)
class Data:
    '''Data.

    Attributes:
        x: A number.
    '''
    x: float
    y: float = 0.0
    z: float = setting(0.0, "Described.")
    own: float = field(init=False)
    shared: ClassVar[int] = 0
class Pair(NamedTuple):
    left: int
    right: int
class _Private(NamedTuple):
    left: int
    right: int
class Alone:
    def __init__(self, a): pass
"""
    shown = dict(undescribed(classes_in(ast.parse(source))))
    assert shown == {"Lacks": ["c"], "Data": ["y"], "Pair": ["left", "right"]}


def test_docstrings_describe_what_classes_are_made_with():
    places = [f"{name}: {', '.join(missing)}" for name, missing in undescribed(classes_in(*syntax_trees().values()))]
    assert not places, "describe arguments under Args:, or fields under Attributes::\n" + "\n".join(places)


def test_misdescribed_arguments_are_found():
    source = """
def right(a, *b, c=1, **d):
    '''Return one.

    Args:
        a: A number
            note: of an entry.
        b, c: Others.
        **d: More.

    Raises:
        e: Never.
    '''
@main.command("run")
def command(a, b): pass
def _private(a, b): pass
def silent(a, b): pass
class Shown:
    def alone(self, a): pass
    def inherited(self, a, b): pass
    @staticmethod
    def lacking(a, b):
        '''Return one.

        Args:
            a: A number.
        '''
    def stale(self, a, b):
        '''Return one.

        Args:
            a: A number.
            b: Another.
            c: A third.
        '''
"""
    assert [name for _, name in misdescribed(ast.parse(source).body)] == ["silent", "lacking", "stale"]


def test_docstrings_describe_the_arguments():
    places = [
        f"{path.relative_to(ROOT)}:{line} {name}"
        for path, tree in syntax_trees("vtbdrake").items()
        for line, name in misdescribed(tree.body)
    ]
    assert not places, "describe each argument under Args:, and no other one:\n" + "\n".join(places)


# Public by their documentation: of Python, of Drake's templates, and what Jupyter calls.
PUBLIC_IN_SPITE = re.compile(r"_exit|_replace|_construct|_repr_\w+_")
PRIVATE = re.compile(r"_[A-Za-z]\w*")
BY_STRING = {"setattr", "getattr", "hasattr", "delattr"}


def is_private(name: str) -> bool:
    return bool(PRIVATE.fullmatch(name)) and not PUBLIC_IN_SPITE.fullmatch(name)


def private_names(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line and name of everything private of other objects and modules that a module uses, also by a string."""
    for node in syntax_nodes(tree):
        match node:
            case ast.Attribute(value=ast.Name(id="self" | "cls") | ast.Call(func=ast.Name(id="super"))):
                names: list[str] = []
            case ast.Attribute(attr=name):
                names = [name]
            case ast.ImportFrom(module=module):
                names = [*(module or "").split("."), *(alias.name for alias in node.names)]
            case ast.Import():
                names = [name for alias in node.names for name in alias.name.split(".")]
            case ast.Call(args=[ast.Name(id="self"), *_]):
                names = []
            case ast.Call(func=ast.Name(id=function) | ast.Attribute(attr=function)) if function in BY_STRING:
                texts = [argument.value for argument in node.args if isinstance(argument, ast.Constant)]
                names = [name for text in texts for name in str(text).split(".")]
            case ast.Subscript(value=ast.Attribute(attr="__dict__"), slice=ast.Constant(value=str(name))):
                names = [name]
            case _:
                continue
        yield from ((node.lineno, name) for name in names if is_private(name))


def test_private_names_of_others_are_found():
    source = """
import package._a
from package import _b, public
self._own.x = value._c
super()._update(self._own, os._exit)
patch.setattr(module, "_d", 0)
patch.setattr("package.module._e", 0)
getattr(self, "_own")
scenario.__dict__["_f"]
file._g._h.shown()._repr_html_()
"""
    names = [name for _, name in private_names(ast.parse(source))]
    assert sorted(names) == ["_a", "_b", "_c", "_d", "_e", "_f", "_g", "_h"]


def test_tests_use_public_names_of_others():
    places = [
        f"{path.relative_to(ROOT)}:{line} {name}"
        for path, tree in syntax_trees("tests").items()
        for line, name in private_names(tree)
    ]
    assert not places, "\n".join(places)
