"""Compiled functions: the same values, made once, and clear words where that fails."""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import textwrap
from pathlib import Path

import casadi
import numpy as np
import pytest
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff

from vtbdrake.components.casadi_system import CasadiSystem, CompilerError
from vtbdrake.components.casadi_system import compiler as compiling
from vtbdrake.components.casadi_system.compiler import compiler_command

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """The folder of the compiled functions, and the log of a compiler that writes down the arguments of its runs.

    Here it optimizes.
    """
    compiler = tmp_path / "logging_cc"
    compiler.write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/log\nexec {shutil.which("cc")} "$@"\n')
    compiler.chmod(0o755)
    monkeypatch.setenv("CC", str(compiler))
    monkeypatch.delenv("CFLAGS")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path


def function(kind=casadi.SX, factor=2.0):
    x, u = kind.sym("x", 3), kind.sym("u", 3)
    y = casadi.vertcat(casadi.sin(x) * u * factor, casadi.exp(-casadi.dot(x, u)), casadi.fmax(x[0], u[1]))
    return casadi.Function("law", [x, u], [y], ["x", "u"], ["y"])


def _eval(system, x, u):
    context = system.CreateDefaultContext()
    system.GetInputPort("x").FixValue(context, x)
    system.GetInputPort("u").FixValue(context, u)
    return system.GetOutputPort("y").Eval(context)


def _runs(folder):
    return len((folder / "log").read_text().splitlines())


@pytest.mark.parametrize("kind", [casadi.SX, casadi.MX])
def test_compiled_computes_what_interpreted_computes(cache, kind):
    interpreted, machine = CasadiSystem(function(kind)), CasadiSystem(function(kind), compile=True)
    rng = np.random.default_rng(2)
    for _ in range(20):
        x, u = rng.normal(size=(2, 3))
        np.testing.assert_array_equal(_eval(machine, x, u), _eval(interpreted, x, u))
    z = InitializeAutoDiff(rng.normal(size=6)).ravel()
    gradients = [ExtractGradient(_eval(system.ToAutoDiffXd(), z[:3], z[3:])) for system in (machine, interpreted)]
    np.testing.assert_allclose(*gradients, rtol=1e-14)
    assert gradients[0].shape == (5, 6)


def test_a_jacobian_that_is_too_long_to_be_compiled_is_interpreted(cache):
    """Few operations, with a dense Jacobian of 330 x 330 entries; a C compiler would need minutes for it."""
    x, u, row = casadi.SX.sym("x", 330), casadi.SX.sym("u", 1), np.linspace(0.1, 1.0, 330)
    y = casadi.sin(row * casadi.sin(casadi.dot(x, x)))
    system = CasadiSystem(casadi.Function("wide", [x, u], [y], ["x", "u"], ["y"]), compile=True)
    assert _runs(cache) == 1
    z = np.linspace(-0.1, 0.1, 330)
    gradient = ExtractGradient(_eval(system.ToAutoDiffXd(), InitializeAutoDiff(z).ravel(), [0.0]))
    inner = z @ z
    expected = np.outer(np.cos(row * np.sin(inner)) * row * np.cos(inner), 2.0 * z)
    np.testing.assert_allclose(gradient, expected, rtol=1e-12, atol=1e-15)
    assert _runs(cache) == 1


def test_a_function_is_compiled_once(cache):
    for _ in range(3):
        CasadiSystem(function(), compile=True)
    assert _runs(cache) == 1
    CasadiSystem(function(factor=3.0), compile=True)
    assert _runs(cache) == 2


def test_flags_of_the_environment_override_the_optimization(cache, monkeypatch):
    CasadiSystem(function(), compile=True)
    monkeypatch.setenv("CFLAGS", "-O0 -DNAME='two words'")
    CasadiSystem(function(), compile=True)
    optimized, other = (cache / "log").read_text().splitlines()
    assert optimized.startswith("-O2 -fPIC") and other.startswith("-O2 -O0 -DNAME=two words -fPIC")
    assert " -ffp-contract=off " in optimized and " -ffp-contract=off " in other


def test_what_the_compiled_function_need_not_compute_is_not_compiled(cache):
    update = casadi.Function("hold", [casadi.SX.sym("u")], [1.0], ["u"], ["x_next"])
    CasadiSystem(update=update, state={"x": 0.0}, period=0.1, compile=True)
    assert _runs(cache) == 1  # the update; the state's port shows the state


def test_processes_may_compile_at_once(cache):
    code = textwrap.dedent("""
        import casadi
        from vtbdrake.components.casadi_system import CasadiSystem
        x = casadi.SX.sym("x", 3)
        system = CasadiSystem(casadi.Function("f", [x], [casadi.sin(x)], ["x"], ["y"]), compile=True)
        context = system.CreateDefaultContext()
        system.get_input_port().FixValue(context, [0.1, 0.2, 0.3])
        print(system.get_output_port().Eval(context).tolist())
    """)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    processes = [
        subprocess.Popen([sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    outputs = [process.communicate(timeout=120)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0]
    assert outputs == [f"{np.sin([0.1, 0.2, 0.3]).tolist()}\n"] * 2
    assert [path.suffix for path in (cache / "cache" / "vtbdrake" / "casadi").iterdir()] == [".so"]


def test_a_missing_compiler_is_named_with_the_remedy(cache, monkeypatch):
    monkeypatch.setenv("CC", "no-such-cc")
    with pytest.raises(CompilerError, match="there is no 'no-such-cc': install one .* or leave out compile=True"):
        CasadiSystem(function(), compile=True)


@pytest.mark.parametrize(
    ("has_cc", "has_zig", "named", "expected"),
    [
        (True, True, "", ["cc"]),
        (False, True, "", [sys.executable, "-m", "ziglang", "cc"]),
        (False, True, "clang -m64", ["clang", "-m64"]),
        (False, False, "", ["cc"]),
    ],
)
def test_the_compiler_is_the_one_that_is_there(tmp_path, monkeypatch, has_cc, has_zig, named, expected):
    programs, packages = tmp_path / "bin", tmp_path / "packages"
    programs.mkdir()
    (packages / "ziglang").mkdir(parents=True)
    (packages / "ziglang" / "__init__.py").touch()
    if has_cc:
        (programs / "cc").symlink_to(shutil.which("cc"))
    if has_zig:
        monkeypatch.syspath_prepend(packages)
    else:
        monkeypatch.setitem(sys.modules, "ziglang", None)
    monkeypatch.setenv("PATH", str(programs))
    monkeypatch.setenv("CC", named)
    assert list(compiler_command())[: len(expected)] == expected


@pytest.mark.parametrize("compiler", ["no-such-cc", "cc -no-such-flag"])
def test_a_function_without_machine_code_may_be_interpreted(cache, monkeypatch, compiler):
    machine = CasadiSystem(function(), compile=None)
    assert _runs(cache) == 1
    monkeypatch.setenv("CC", compiler)
    interpreted = CasadiSystem(function(), compile=None)
    x, u = np.random.default_rng(3).normal(size=(2, 3))
    np.testing.assert_array_equal(_eval(interpreted, x, u), _eval(machine, x, u))


def test_a_compiler_that_fails_leaves_nothing_behind(cache, monkeypatch):
    monkeypatch.setenv("CC", f"{shutil.which('cc')} -no-such-flag")
    with pytest.raises(CompilerError, match="no-such-flag"):
        CasadiSystem(function(), compile=True)
    assert list((cache / "cache" / "vtbdrake" / "casadi").iterdir()) == []
    monkeypatch.setenv("CC", "cc")
    np.testing.assert_allclose(_eval(CasadiSystem(function(), compile=True), np.zeros(3), np.ones(3))[3], 1.0)


def test_a_compiler_that_does_not_end_is_ended(cache, monkeypatch):
    compiler = cache / "endless_cc"
    compiler.write_text("#!/bin/sh\nexec sleep 1000\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("CC", str(compiler))
    monkeypatch.setattr(compiling, "LONGEST_COMPILATION", 0.2)
    with pytest.raises(CompilerError, match="endless_cc did not end within 0.2 s: compile a smaller part"):
        CasadiSystem(function(), compile=True)
    assert list((cache / "cache" / "vtbdrake" / "casadi").iterdir()) == []


def test_ctrl_c_ends_all_processes_of_a_compiler_and_leaves_nothing_behind(cache, monkeypatch):
    compiler, goes_on, temporary = cache / "slow_cc", cache / "goes_on", cache / "tmp"
    temporary.mkdir()
    os.mkfifo(goes_on)
    # It complains at more length than a pipe holds, so that somebody listens to it before it sends Ctrl-C.
    compiler.write_text(
        "#!/bin/sh\nmktemp\nhead -c 200000 /dev/zero >&2\n"
        f"(kill -INT $PPID; sleep 1; echo goes on) > {goes_on} 2> /dev/null &\nwait\n"
    )
    compiler.chmod(0o755)
    monkeypatch.setenv("CC", str(compiler))
    monkeypatch.setenv("TMPDIR", str(temporary))
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    child = os.open(goes_on, os.O_RDONLY | os.O_NONBLOCK)
    with pytest.raises(KeyboardInterrupt):
        CasadiSystem(function(), compile=True)
    os.set_blocking(child, True)
    assert os.read(child, 100) == b""  # It has ended without a word.
    os.close(child)
    assert not list(temporary.iterdir())
    assert not list((cache / "cache").rglob("law*"))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_compiler_ends_with_its_parent(cache, monkeypatch, number):
    """Two real processes: the parent dies by a signal in the middle of a compilation."""
    compiler, lives, temporary, programs = (cache / name for name in ("slow_cc", "lives", "tmp", "bin"))
    removed = cache / "removed"
    for folder in (temporary, programs):
        folder.mkdir()
    for fifo in (lives, removed):
        os.mkfifo(fifo)
    (programs / "rm").write_text(f'#!/bin/sh\n{shutil.which("rm")} "$@"; echo "$@" > {removed}\n')
    (programs / "rm").chmod(0o755)
    # Its child, as `cc1` is one of `cc`, says who the parent is, and keeps the other end of the fifo open.
    compiler.write_text(f"#!/bin/sh\nmktemp\n(echo $PPID; sleep 20; echo goes on) > {lives} &\nwait\n")
    compiler.chmod(0o755)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "CC": str(compiler), "TMPDIR": str(temporary)}
    environment["PATH"] = f"{programs}:{environment['PATH']}"
    script = "import tests.components.casadi_system.test_compiler as t\nt.CasadiSystem(t.function(), compile=True)"
    parent = subprocess.Popen([sys.executable, "-c", script], env=environment, stderr=subprocess.DEVNULL)
    with lives.open() as fifo:
        assert int(fifo.readline()) == parent.pid
        assert list(temporary.iterdir())
        parent.send_signal(number)
        assert parent.wait() == -number
        assert fifo.read() == ""  # All that kept it open have ended.
    assert not list((cache / "cache").rglob("law*"))
    assert removed.read_text().startswith("-rf ") and not list(temporary.iterdir())


def test_long_compilations_are_told(cache, caplog, monkeypatch):
    CasadiSystem(function(), compile=True)
    assert not caplog.messages
    monkeypatch.setattr(compiling, "LARGE_SOURCE", 1000)
    CasadiSystem(function(factor=3.0), compile=True)
    before, after = caplog.messages
    assert before.startswith("compiling law_y: 0.0 MB of C by ") and str(cache / "cache" / "vtbdrake") in before
    assert after.startswith("law_y is compiled, after ")


def _without_the_end(contents: bytes, size: int) -> bytes:
    return contents[:size]


def _with_zeros(contents: bytes, start: int) -> bytes:
    return contents[:start] + bytes(400) + contents[start + 400 :]


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("damage", "place"),
    [(_without_the_end, size) for size in (0, 10, 500, 1000, 5000, 10_000)] + [(_with_zeros, 100), (_with_zeros, 5000)],
)
def test_a_damaged_library_is_compiled_again(cache, damage, place):
    CasadiSystem(function(), compile=True)
    (library,) = (cache / "cache").rglob("*.so")
    contents = library.read_bytes()
    library.unlink()  # This process has loaded it.
    library.write_bytes(damage(contents, place))
    # In another process: the loader of a library that lacks a part ends its process.
    script = "import tests.components.casadi_system.test_compiler as t\nt.CasadiSystem(t.function(), compile=True)"
    subprocess.run([sys.executable, "-c", script], check=True, env={**os.environ, "PYTHONPATH": str(ROOT)})
    assert _runs(cache) == 2
    machine, interpreted = CasadiSystem(function(), compile=True), CasadiSystem(function())
    x, u = np.arange(3.0), np.ones(3)
    np.testing.assert_array_equal(_eval(machine, x, u), _eval(interpreted, x, u))
    assert _runs(cache) == 2


def test_python_inside_a_function_cannot_be_compiled(cache):
    class Doubled(casadi.Callback):
        def __init__(self):
            super().__init__()
            self.construct("doubled", {})

        def eval(self, arguments):
            return [2 * arguments[0]]

    x, doubled = casadi.MX.sym("x"), Doubled()
    function = casadi.Function("law", [x], [doubled(x)], ["x"], ["y"])
    with pytest.raises(
        ValueError, match="law_y contains CallbackInternal, for which there is no C code: leave out compile=True"
    ):
        CasadiSystem(function, compile=True)


def test_a_function_that_reports_failure_is_an_error(tmp_path):
    source = tmp_path / "picky.c"
    source.write_text("""
        int picky(const double** arg, double** res, long long* iw, double* w, int mem) {
            if (arg[0][0] < 0) return 1;
            res[0][0] = arg[0][0];
            return 0;
        }
    """)
    library = tmp_path / "picky.so"
    subprocess.run(["cc", "-shared", "-fPIC", str(source), "-o", str(library)], check=True)
    x = casadi.MX.sym("x")
    picky = casadi.external("picky", str(library))
    system = CasadiSystem(casadi.Function("law", [x], [picky(x)], ["x"], ["y"]))
    context = system.CreateDefaultContext()
    system.get_input_port().FixValue(context, [2.0])
    assert system.get_output_port().Eval(context) == [2.0]
    system.get_input_port().FixValue(context, [-2.0])
    with pytest.raises(RuntimeError, match=r"CasADi could not evaluate law_y at \[-2.0\]"):
        system.get_output_port().Eval(context)
