"""Names say what a thing is: words that fit anything are counted, and have a budget."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.one_python

ROOT = Path(__file__).resolve().parents[1]

# Words that stand where a type or a role should, as whole names. In a line or two they may be the best ones.
VAGUE = {"found", "known", "one", "own", "given", "chosen", "kept"}
VAGUE |= {"seen", "what", "others", "asked", "wanted", "told", "held"}
BUDGET = 20


def bound_names(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line and name of everything that a module binds: variables, attributes, arguments, functions, classes."""
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()) | ast.arg(arg=name):
                yield node.lineno, name
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield node.lineno, name


def vague_names(source: str) -> list[tuple[int, str]]:
    return [(line, name) for line, name in bound_names(ast.parse(source)) if name.strip("_") in VAGUE]


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
    names = {name for _, name in vague_names(source)}
    assert names == {"found", "known", "given", "one", "_own", "what", "held", "others"}


def test_few_names_say_nothing_of_what_they_name():
    places = [
        f"{path.relative_to(ROOT)}:{line} {name}"
        for folder in ("vtbdrake", "diagrams")
        for path in sorted((ROOT / folder).rglob("*.py"))
        for line, name in vague_names(path.read_text(encoding="utf-8"))
    ]
    assert len(places) <= BUDGET, "\n".join(places)
