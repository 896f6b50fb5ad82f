"""A study notices edits of a function and of what it uses, but not of the way that it is written."""

import functools
import importlib
import itertools
import linecache
import os
import shutil
import subprocess
import sys
import threading
import types
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

import numpy as np
import pytest

from vtbdrake.optimization.digest import digest

ROOT = Path(__file__).resolve().parents[2]
HEAD = "import dataclasses, enum, functools, operator, collections\nimport numpy as np\n"

# name -> (source of a function f, the same after an edit that changes what f computes)
EDITS = {
    "number in the body": ("f = lambda x: x * 2.0", "f = lambda x: x * 3.0"),
    "operator": ("def f(x): return x - 1", "def f(x): return x + 1"),
    "another lambda on its line": (
        "f, g = lambda x: abs(x), lambda x: x * x",
        "g, f = lambda x: abs(x), lambda x: x * x",
    ),
    "attribute's name": ("def f(x): return x.real", "def f(x): return x.imag"),
    "exception handler": (
        "def f(x):\n try: return 1 / x\n except ZeroDivisionError: return 0",
        "def f(x):\n try: return 1 / x\n except ValueError: return 0",
    ),
    "set in the body": ("def f(x): return x in {1, 2, 3}", "def f(x): return x in {1, 2, 4}"),
    "global number": ("A = 1\ndef f(x): return A * x", "A = 2\ndef f(x): return A * x"),
    "global list": ("A = [1, 2]\ndef f(x): return sum(A)", "A = [1, 3]\ndef f(x): return sum(A)"),
    "list in a list": ("A = [[1], [2]]\ndef f(x): return A[1][0]", "A = [[1], [3]]\ndef f(x): return A[1][0]"),
    "global dict": ("A = {'a': 1}\ndef f(x): return A['a']", "A = {'a': 2}\ndef f(x): return A['a']"),
    "key of a dict": ("A = {'a': 1}\ndef f(x): return min(A)", "A = {'b': 1}\ndef f(x): return min(A)"),
    "swapped values of a dict": (
        "A = {'a': [1], 'b': [2]}\ndef f(x): return A['a']",
        "A = {'a': [2], 'b': [1]}\ndef f(x): return A['a']",
    ),
    "global set": ("A = {'a', 'b'}\ndef f(x): return len(A)", "A = {'a', 'c'}\ndef f(x): return len(A)"),
    "global array": ("A = np.arange(3.0)\ndef f(x): return A @ A", "A = np.arange(3.0) + 1\ndef f(x): return A @ A"),
    "shape of an array": ("A = np.ones((2, 3))\ndef f(x): return A", "A = np.ones((3, 2))\ndef f(x): return A"),
    "deque": (
        "A = collections.deque([1, 2])\ndef f(x): return A[0]",
        "A = collections.deque([2, 1])\ndef f(x): return A[0]",
    ),
    "dataclass instance": (
        "@dataclasses.dataclass\nclass C:\n  a: float\nA = C(1.0)\ndef f(x): return A.a",
        "@dataclasses.dataclass\nclass C:\n  a: float\nA = C(2.0)\ndef f(x): return A.a",
    ),
    "default factory": (
        "@dataclasses.dataclass\nclass C:\n  a: list = dataclasses.field(default_factory=lambda: [1])\n"
        "def f(x): return C().a",
        "@dataclasses.dataclass\nclass C:\n  a: list = dataclasses.field(default_factory=lambda: [2])\n"
        "def f(x): return C().a",
    ),
    "default of a field with slots": (
        "@dataclasses.dataclass(slots=True)\nclass C:\n  a: int = 1\ndef f(x): return C().a",
        "@dataclasses.dataclass(slots=True)\nclass C:\n  a: int = 2\ndef f(x): return C().a",
    ),
    "attribute of an object": (
        "class C: pass\nA = C()\nA.a = 1\ndef f(x): return A.a",
        "class C: pass\nA = C()\nA.a = 2\ndef f(x): return A.a",
    ),
    "slot of an object": (
        "class C: __slots__ = 'a',\nA = C()\nA.a = 1\ndef f(x): return A.a",
        "class C: __slots__ = 'a',\nA = C()\nA.a = 2\ndef f(x): return A.a",
    ),
    "object in an object": (
        "class C:\n def __init__(s, a): s.a = a\nA = C(C([1]))\ndef f(x): return A.a.a",
        "class C:\n def __init__(s, a): s.a = a\nA = C(C([2]))\ndef f(x): return A.a.a",
    ),
    "method of an object": (
        "class C:\n def m(s, x): return x\nA = C()\ndef f(x): return A.m(x)",
        "class C:\n def m(s, x): return -x\nA = C()\ndef f(x): return A.m(x)",
    ),
    "callable object's list": (
        "class C:\n def __init__(s, a): s.a = a\n def __call__(s, x): return s.a[0]\nf = C([1])",
        "class C:\n def __init__(s, a): s.a = a\n def __call__(s, x): return s.a[0]\nf = C([2])",
    ),
    "bound method's object": (
        "class C:\n def __init__(s, a): s.a = a\n def m(s, x): return s.a[0]\nf = C([1]).m",
        "class C:\n def __init__(s, a): s.a = a\n def m(s, x): return s.a[0]\nf = C([2]).m",
    ),
    "list of a class": ("class C: a = [1]\ndef f(x): return C.a", "class C: a = [2]\ndef f(x): return C.a"),
    "base class": (
        "class B:\n def m(s): return 1\nclass C(B): pass\ndef f(x): return C().m()",
        "class B:\n def m(s): return 2\nclass C(B): pass\ndef f(x): return C().m()",
    ),
    "property": (
        "class C:\n @property\n def a(s): return 1\ndef f(x): return C().a",
        "class C:\n @property\n def a(s): return 2\ndef f(x): return C().a",
    ),
    "class method": (
        "class C:\n @classmethod\n def a(c): return 1\ndef f(x): return C.a()",
        "class C:\n @classmethod\n def a(c): return 2\ndef f(x): return C.a()",
    ),
    "enumeration": (
        "class E(enum.Enum): A = 1\ndef f(x): return E.A.value",
        "class E(enum.Enum): A = 2\ndef f(x): return E.A.value",
    ),
    "named tuple": (
        "T = collections.namedtuple('T', 'a b')\nA = T(1, [2])\ndef f(x): return A.b",
        "T = collections.namedtuple('T', 'a b')\nA = T(1, [3])\ndef f(x): return A.b",
    ),
    "partial's argument": (
        "def g(x, a): return x\nf = functools.partial(g, a=[1])",
        "def g(x, a): return x\nf = functools.partial(g, a=[2])",
    ),
    "partial's function": (
        "def g(x, a): return x\nf = functools.partial(g, a=1)",
        "def g(x, a): return -x\nf = functools.partial(g, a=1)",
    ),
    "global partial": (
        "def g(x, a): return x\nP = functools.partial(g, a=1)\ndef f(x): return P(x)",
        "def g(x, a): return x\nP = functools.partial(g, a=2)\ndef f(x): return P(x)",
    ),
    "function in a cache": (
        "@functools.lru_cache\ndef g(x): return x\ndef f(x): return g(x)",
        "@functools.lru_cache\ndef g(x): return -x\ndef f(x): return g(x)",
    ),
    "cached f": ("@functools.cache\ndef f(x): return x", "@functools.cache\ndef f(x): return -x"),
    "vectorized function": (
        "V = np.vectorize(lambda x: x)\ndef f(x): return V(x)",
        "V = np.vectorize(lambda x: -x)\ndef f(x): return V(x)",
    ),
    "single dispatch": (
        "@functools.singledispatch\ndef f(x): return x\n@f.register\ndef _(x: int): return 1",
        "@functools.singledispatch\ndef f(x): return x\n@f.register\ndef _(x: int): return 2",
    ),
    "wrapped function": (
        "def d(g):\n @functools.wraps(g)\n def w(x): return g(x)\n return w\n@d\ndef f(x): return x",
        "def d(g):\n @functools.wraps(g)\n def w(x): return g(x)\n return w\n@d\ndef f(x): return -x",
    ),
    "decorator": (
        "def d(g):\n @functools.wraps(g)\n def w(x): return g(x)\n return w\n@d\ndef f(x): return x",
        "def d(g):\n @functools.wraps(g)\n def w(x): return -g(x)\n return w\n@d\ndef f(x): return x",
    ),
    "function in a decorating object": (
        "class D:\n def __init__(s, g): functools.update_wrapper(s, g)\n def __call__(s, x): return s.__wrapped__(x)\n"
        "@D\ndef f(x): return x",
        "class D:\n def __init__(s, g): functools.update_wrapper(s, g)\n def __call__(s, x): return s.__wrapped__(x)\n"
        "@D\ndef f(x): return -x",
    ),
    "attribute of a function": ("def f(x): return f.a\nf.a = [1]", "def f(x): return f.a\nf.a = [2]"),
    "default value": ("def f(x, a=[1]): return a", "def f(x, a=[2]): return a"),
    "keyword default": ("def f(x, *, a=(1, [1])): return a", "def f(x, *, a=(1, [2])): return a"),
    "closure": (
        "def make(a):\n return lambda x: a[0]\nf = make([1])",
        "def make(a):\n return lambda x: a[0]\nf = make([2])",
    ),
    "swapped closures": (
        "def make(a):\n return lambda x: a\np, q = make(1), make(2)\ndef f(x): return p(x)",
        "def make(a):\n return lambda x: a\nq, p = make(1), make(2)\ndef f(x): return p(x)",
    ),
    "function in a list": (
        "L = [lambda x: x]\ndef f(x): return L[0](x)",
        "L = [lambda x: -x]\ndef f(x): return L[0](x)",
    ),
    "function of a function": (
        "def h(x): return x\ndef g(x): return h(x)\ndef f(x): return g(x)",
        "def h(x): return -x\ndef g(x): return h(x)\ndef f(x): return g(x)",
    ),
    "mutual recursion": (
        "def f(x): return g(x - 1) if x else 0\ndef g(x): return f(x) + 1",
        "def f(x): return g(x - 1) if x else 0\ndef g(x): return f(x) + 2",
    ),
    "comprehension": (
        "A = 1\ndef f(x): return [A * i for i in range(3)]",
        "A = 2\ndef f(x): return [A * i for i in range(3)]",
    ),
    "item getter": ("f = operator.itemgetter(0)", "f = operator.itemgetter(1)"),
    "compiled pattern": (
        "import re\nR = re.compile('a')\ndef f(x): return R",
        "import re\nR = re.compile('b')\ndef f(x): return R",
    ),
    "poly1d": ("P = np.poly1d([1, 2])\ndef f(x): return P(x)", "P = np.poly1d([1, 3])\ndef f(x): return P(x)"),
    "spline of scipy": (
        "from scipy.interpolate import CubicSpline\nS = CubicSpline([0, 1, 2], [0, 1, 0])\ndef f(x): return S(x)",
        "from scipy.interpolate import CubicSpline\nS = CubicSpline([0, 1, 2], [0, 2, 0])\ndef f(x): return S(x)",
    ),
    "pose of Drake": (
        "from pydrake.math import RigidTransform\nX = RigidTransform([0, 0, 1.0])\ndef f(x): return X",
        "from pydrake.math import RigidTransform\nX = RigidTransform([0, 0, 2.0])\ndef f(x): return X",
    ),
    "list in a cycle": (
        "A = [1]\nA.append(A)\ndef f(x): return A[1][0]",
        "A = [2]\nA.append(A)\ndef f(x): return A[1][0]",
    ),
}

# name -> (source of a function f, the same written or made in another way)
NO_EDITS = {
    "the cell run again": ("A = [1]\nf = lambda x: A[0]", "A = [1]\nf = lambda x: A[0]"),
    "other line numbers": (
        "def f(x):\n return [x\n  for _ in 'ab']",
        "\n\n\n\ndef f(x):\n return [x\n  for _ in 'ab']",
    ),
    "comments": ("def f(x):\n return x", "def f(x):  # a comment\n # another one\n return x"),
    "docstring": ("def f(x):\n 'old'\n return x", "def f(x):\n 'new'\n return x"),
    "white space": ("def f(x): return (x+1)*2", "def f( x ): return ( x + 1 ) * 2"),
    "annotations": ("def f(x): return x", "def f(x: float) -> float: return x"),
    "a local variable's name": ("def f(x):\n y = x\n return y", "def f(x):\n z = x\n return z"),
    "order of definitions": (
        "def g(x): return x\ndef h(x): return -x\ndef f(x): return g(x) + h(x)",
        "def h(x): return -x\ndef f(x): return g(x) + h(x)\ndef g(x): return x",
    ),
    "order of imports": ("import math, cmath\nf = lambda x: math.pi", "import cmath, math\nf = lambda x: math.pi"),
    "order of a set": ("A = {*'abcdefgh'}\ndef f(x): return A", "A = {*'hgfedcba'}\ndef f(x): return A"),
    "order of a dict": ("A = {'a': 1, 'b': 2}\ndef f(x): return A", "A = {'b': 2, 'a': 1}\ndef f(x): return A"),
    "order of a registry": (
        "R = {}\nR['a'] = lambda: 1\nR['b'] = lambda: 2\ndef f(x): return R[x]()",
        "R = {}\nR['b'] = lambda: 2\nR['a'] = lambda: 1\ndef f(x): return R[x]()",
    ),
    "what f does not use": ("A = [1]\ndef g(x): return 1\ndef f(x): return x", "A = [2]\ndef f(x): return x"),
    "another lambda on its line": ("f, g = lambda x: x, lambda x: 1", "f, g = lambda x: x, lambda x: 2"),
    "a shared list": ("B = [1]\nA = [B, B]\ndef f(x): return A", "A = [[1], [1]]\ndef f(x): return A"),
    "a number of numpy": ("A = np.float64(0.3)\ndef f(x): return A", "A = 0.3\ndef f(x): return A"),
    "memory order of an array": (
        "A = np.arange(6.0).reshape(2, 3)\ndef f(x): return A",
        "A = np.asfortranarray(np.arange(6.0).reshape(2, 3))\ndef f(x): return A",
    ),
    "a cache that was used": (
        "@functools.lru_cache\ndef f(x): return x",
        "@functools.lru_cache\ndef f(x): return x\nf(1), f(2)",
    ),
    "a vectorized function that was used": (
        "f = np.vectorize(lambda x: x, otypes=[float])",
        "f = np.vectorize(lambda x: x, otypes=[float])\nf([1, 2])",
    ),
    "a cached property that was used": (
        "class C:\n @functools.cached_property\n def a(s): return 1\nA = C()\ndef f(x): return A.a",
        "class C:\n @functools.cached_property\n def a(s): return 1\nA = C()\ndef f(x): return A.a\nA.a",
    ),
    "a single dispatch that was used": (
        "@functools.singledispatch\ndef f(x): return x\n@f.register\ndef _(x: int): return 1",
        "@functools.singledispatch\ndef f(x): return x\n@f.register\ndef _(x: int): return 1\nf(1), f('a')",
    ),
    "another object in a cycle": ("A = [1]\nA.append(A)\nf = lambda x: A", "A = [1]\nA.append(A)\nf = lambda x: A"),
}

_cells = itertools.count()


def made(source, name="a_cell"):
    """Return the function f of a cell of a notebook, with the source where `inspect` looks for it."""
    file, source = f"<cell {next(_cells)}>", HEAD + source + "\n"
    linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)
    sys.modules[name] = types.ModuleType(name)
    exec(compile(source, file, "exec"), vars(sys.modules[name]))
    return sys.modules[name].f


@pytest.mark.parametrize(("before", "after"), EDITS.values(), ids=EDITS)
def test_edits_are_noticed(before, after):
    assert digest(made(before))[0] != digest(made(after))[0]


@pytest.mark.parametrize(("before", "after"), NO_EDITS.values(), ids=NO_EDITS)
def test_what_is_no_edit_is_not_noticed(before, after):
    assert digest(made(before)) == digest(made(after))


@pytest.mark.slow
def test_other_processes_and_hash_seeds_have_the_same_digests():
    code = (
        "from tests.optimization.test_digest import EDITS, NO_EDITS, digest, made\n"
        "print([digest(made(source)) for pair in [*EDITS.values(), *NO_EDITS.values()] for source in pair])"
    )
    outputs = {
        subprocess.run(
            [sys.executable, "-c", code],
            cwd=ROOT,
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("0", "77")
    }
    assert len(outputs) == 1
    # Every function was read to its end.
    assert outputs.pop().count("()") == 2 * (len(EDITS) + len(NO_EDITS))


def test_functions_of_installed_packages_are_their_names_and_what_they_hold():
    assert digest(np.median) == digest(np.median) != digest(np.mean)
    assert digest(functools.partial(np.clip, a_min=0)) != digest(functools.partial(np.clip, a_min=1))
    # A function of a package that no name leads to holds values.
    assert digest(shutil.ignore_patterns("a")) == digest(shutil.ignore_patterns("a"))
    assert digest(shutil.ignore_patterns("a")) != digest(shutil.ignore_patterns("b"))


@pytest.mark.parametrize("statement", ["import {0}; return {0}.A", "from {0} import A; return A", "from . import {0}"])
def test_a_module_that_f_imports_when_it_runs(tmp_path, monkeypatch, statement):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    package = tmp_path / "a_package_of_a_test"
    package.mkdir()
    (package / "__init__.py").touch()

    def digest_with(number):
        for folder in (tmp_path, package):
            (folder / "gains_of_a_test.py").write_text(f"import other_of_a_test\nA = {number}")
        (tmp_path / "other_of_a_test.py").write_text("raise ValueError('it is not to be imported here')")
        importlib.invalidate_caches()
        source = f"__package__ = 'a_package_of_a_test'\ndef f(x): {statement.format('gains_of_a_test')}"
        return digest(made(source))[0]

    assert digest_with(1) == digest_with(1) != digest_with(22)
    assert "gains_of_a_test" not in sys.modules


LAWS_IN_CYTHON = """
from used_by_a_test cimport something

def first(double x):
    return 2.0 * x

def second(double x):
    return 3.0 * x
"""
SETUP_OF_CYTHON = """
from Cython.Build import cythonize
from setuptools import setup

setup(ext_modules=cythonize("laws_of_a_test.pyx", language_level=3))
"""
USED_IN_CYTHON = "cdef inline double something():\n    return 1.0\n"


@pytest.fixture(scope="module")
def built_from_cython(tmp_path_factory):
    """A folder with a library that is compiled from Cython, and its sources."""
    folder = tmp_path_factory.mktemp("cython")
    (folder / "laws_of_a_test.pyx").write_text(LAWS_IN_CYTHON)
    (folder / "used_by_a_test.pxd").write_text(USED_IN_CYTHON)
    (folder / "setup.py").write_text(SETUP_OF_CYTHON)
    command = [sys.executable, "setup.py", "-q", "build_ext", "--inplace"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True, env={**os.environ, "CFLAGS": "-O0"})
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("edited", ["laws_of_a_test.pyx", "used_by_a_test.pxd", None])
def test_a_function_compiled_from_cython_changes_with_its_source(edited, built_from_cython, tmp_path, monkeypatch):
    for file in built_from_cython.iterdir():
        if file.is_file():
            shutil.copy(file, tmp_path)
    (tmp_path / f"used_by_a_test{EXTENSION_SUFFIXES[0]}").touch()  # It is found, and never imported.
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "laws_of_a_test", raising=False)
    module = importlib.import_module("laws_of_a_test")
    before, unreadable = digest(module.first)
    assert unreadable == () and digest(module.second)[0] != before
    if edited:
        with open(tmp_path / edited, "a") as file:
            file.write("\n# Changed.\n")
    assert (digest(module.first)[0] == before) == (edited is None)


def test_modules_that_import_each_other(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    module = types.ModuleType("modules_of_a_test")
    module.__dict__.update(other=module, gain=[1.0])
    monkeypatch.setitem(sys.modules, "modules_of_a_test", module)
    f = made("def f(x): return m.other.other.gain")
    f.__globals__["m"] = module
    before = digest(f)
    module.gain.append(2.0)
    assert digest(f) != before


@pytest.mark.parametrize("module", ["pydrake.math", pytest.param("pydrake.all", marks=pytest.mark.slow)])
def test_drake_is_the_same_after_more_of_it_was_imported(module):
    code = (
        "from vtbdrake.optimization.digest import digest; from pydrake.common.value import Value\n"
        f"before = digest(Value); import {module}; assert digest(Value) == before"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


def test_a_long_chain_of_objects_has_a_digest():
    chain = None
    for number in range(2000):
        chain = [number, chain]
    assert digest(chain) == digest(chain)


@pytest.mark.parametrize("value", [threading.Lock(), (x for x in "ab"), memoryview(b"ab")])
def test_what_cannot_be_read_is_told(value):
    f = made("def f(x): return A")
    f.__globals__["A"] = {"key": [value]}
    assert digest(f)[1] == (f"builtins.{type(value).__qualname__}".replace("builtins.lock", "_thread.lock"),)
