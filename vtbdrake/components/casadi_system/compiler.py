"""A casadi.Function as machine code: written as C, compiled once, and kept for the next time."""

from __future__ import annotations

import hashlib
import logging
import os
import platform
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import casadi

from vtbdrake.state.archive import whole_file

_log = logging.getLogger(__name__)

LARGE_SOURCE = 500_000
"""Bytes of C code that take so long to compile that the user is told."""
LONGEST_COMPILATION = 600.0
"""s. The time that a compiler gets for one function; an arm's testbed takes some seconds."""
# How long optimizing compilers take for a byte of C code, in s.
_SECONDS_PER_BYTE = 15e-6
# Runs the compiler "$@" beside a watcher, which reads a line when the compiler has ended. If standard input closes
# without one, this process has ended, by whatever signal: then the watcher ends the compiler with its children (it
# ignores the signal that it sends to the group), and removes its files.
_WITH_PARENT = """\
exec 3<&0 </dev/null
(trap '' TERM; read -r _ <&3 || { kill -TERM 0; rm -rf "$TMPDIR"; kill -KILL 0; }) 2>/dev/null &
exec "$@" 3<&-
"""
_ONE_AT_A_TIME = threading.Lock()
_DIGEST_SIZE = hashlib.sha256().digest_size
_KERNELS: dict[str, tuple[Path, str]] = {}  # Functions that are written in C -> their libraries and their sources.


class CompilerError(RuntimeError):
    """There is no C compiler, or it failed."""


def compiled(function: casadi.Function) -> casadi.Function:
    """Return the same function as machine code.

    The library is kept in `cache_folder` under a digest of its C code and of how it was compiled: a function is
    compiled once per machine. Processes may do so at the same time. A damaged library is compiled again.

    Raises:
        ValueError: The function has no C code, such as a `casadi.Callback`.
        CompilerError: The compiler (`compiler_command`) is missing or fails.
    """
    generator = casadi.CodeGenerator(f"{function.name()}.c", {})
    generator.add(function)
    source = generator.dump()
    # CasADi leaves the complaint to the compiler.
    impossible = re.findall(r"#error Code generation not supported for (\w+)", source)
    if impossible:
        raise ValueError(
            f"{function.name()} contains {', '.join(impossible)}, for which there is no C code: leave out compile=True."
        )
    kernels = _kernels_in(source)
    return _loaded(function.name(), source, _library(function.name(), source, kernels), kernels)


def compiled_kernel(name: str, source: str) -> casadi.Function:
    """Return a function that is written in C, such as a solver; it has no derivatives.

    Functions in which it is called can be compiled.

    Args:
        name: Its name, which only this source has.
        source: The C code, a whole translation unit, of the function and of what `casadi.external` asks for.

    Raises:
        CompilerError: The compiler (`compiler_command`) is missing or fails.
    """
    library = _library(name, source, ())
    function = _loaded(name, source, library, ())
    _KERNELS[name] = library, source
    return function


def kernel_library(name: str) -> Path:
    """Return the file of the library of a kernel (see `compiled_kernel`) of this process."""
    return _KERNELS[name][0]


def kernel_signature(name: str, shapes_in: Sequence[tuple[int, int]], shapes_out: Sequence[tuple[int, int]]) -> str:
    """Return the C functions that describe a kernel of dense matrices to CasADi.

    Args:
        name: The name of the kernel.
        shapes_in: The shapes of its arguments.
        shapes_out: The shapes of its results.
    """
    parts = []
    for kind, shapes in (("in", shapes_in), ("out", shapes_out)):
        table = ", ".join(f"{{{rows}, {columns}, 1}}" for rows, columns in shapes)
        parts.append(
            f"long long int {name}_n_{kind}(void) {{ return {len(shapes)}; }}\n"
            f"const long long int *{name}_sparsity_{kind}(long long int i) {{\n"
            f"    static const long long int dense[][3] = {{{table}}};\n    return dense[i];\n}}\n"
        )
    return "\n" + "".join(parts)


def _kernels_in(source: str) -> tuple[Path, ...]:
    """Return the libraries of the kernels that a function calls."""
    return tuple(library for library, _ in _called_kernels(source))


def kernel_sources(source: str) -> tuple[str, ...]:
    """Return the C code of the kernels (see `compiled_kernel`) that the C code of a function calls."""
    return tuple(text for _, text in _called_kernels(source))


def _called_kernels(source: str) -> list[tuple[Path, str]]:
    called = set(re.findall(r"^int (\w+)\(", source, re.MULTILINE))
    return [kernel for name, kernel in _KERNELS.items() if name in called]


def _library(name: str, source: str, kernels: Sequence[Path]) -> Path:
    """Return the file of a function's library in the cache, which need not be there."""
    recipe = (
        source,
        *_command_with_flags(),
        platform.system(),
        platform.machine(),
        "with its digest",
        *map(str, kernels),
    )
    return cache_folder() / f"{name}-{hashlib.sha256(chr(10).join(recipe).encode()).hexdigest()}.so"


def _loaded(name: str, source: str, library: Path, kernels: Sequence[Path]) -> casadi.Function:
    """Return the function in a library, which is compiled if it is not there."""
    with _ONE_AT_A_TIME:
        try:
            if not _is_whole(library):
                if library.exists():
                    _log.warning("%s is damaged, and compiled again", library)
                compile_library(source, library, kernels)
        except OSError as error:
            raise CompilerError(
                f"compiled libraries cannot be kept in {library.parent} ({error}): name another folder in the "
                "environment variable XDG_CACHE_HOME"
            ) from error
        try:
            return casadi.external(name, str(library))
        except RuntimeError as error:
            _log.warning("%s cannot be loaded, and is compiled again: %s", library, str(error).splitlines()[-1])
            library.unlink(missing_ok=True)
            compile_library(source, library, kernels)
    try:
        return casadi.external(name, str(library))
    except RuntimeError as error:
        raise CompilerError(
            f"what {compiler_command()[0]} makes cannot be loaded: {str(error).splitlines()[-1]}"
        ) from None


def compiled_if_possible(function: casadi.Function) -> casadi.Function:
    """Return the same function as machine code, or the function itself if that fails; the log says why."""
    try:
        return compiled(function)
    except (CompilerError, ValueError, OSError) as error:
        _log.info("%s is interpreted: %s", function.name(), error)
        return function


def cache_folder() -> Path:
    """Return the folder of the compiled libraries: ``vtbdrake/casadi`` in XDG_CACHE_HOME, or in ``~/.cache``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vtbdrake" / "casadi"


def _is_whole(library: Path) -> bool:
    """Return whether a library ends with the digest of the rest.

    The loader does not notice that a part is missing: it ends the process, by SIGBUS or SIGSEGV.
    """
    try:
        contents = library.read_bytes()
    except FileNotFoundError:
        return False
    return contents[-_DIGEST_SIZE:] == _digest(contents[:-_DIGEST_SIZE])


def _digest(contents: bytes) -> bytes:
    return hashlib.sha256(contents).digest()


def compiler_command() -> tuple[str, ...]:
    """Return the command of the C compiler, which need not be there.

    It is what the environment variable CC names; else ``cc``; else, where there is no ``cc``, the compiler of the wheel
    `ziglang` (the extra ``compiler``), which brings its own C library's headers: it compiles for any processor of this
    kind and for glibc, as ``cc`` does, not for the one processor that it runs on.
    """
    if named := shlex.split(os.environ.get("CC") or ""):
        return tuple(named)
    if shutil.which("cc") is None and find_spec("ziglang") is not None:
        target = f"{platform.machine()}-linux-gnu"
        return (sys.executable, "-m", "ziglang", "cc", "-target", target, "-mcpu=baseline")
    return ("cc",)


def _command_with_flags() -> tuple[str, ...]:
    """Return the compiler's command with its flags, among them those in the environment variable CFLAGS.

    With ``-O0`` there, a function is compiled several times as fast and computes the same, more slowly: in any case
    products and sums are rounded one by one, as the interpreted function does it.
    """
    flags = shlex.split(os.environ.get("CFLAGS") or "")
    return (*compiler_command(), "-O2", *flags, "-fPIC", "-shared", "-ffp-contract=off")


def compile_library(source: str, library: Path, kernels: Sequence[Path] = ()) -> None:
    """Compile C code to a shared library, which is written whole or not at all, and ends with its digest.

    Args:
        source: The C code, a whole translation unit.
        library: The file of the library; its folder is made if there is none, for this user alone.
        kernels: Libraries that it calls.

    Raises:
        CompilerError: The compiler is missing or fails, or does not end.
    """
    command = _command_with_flags()
    if shutil.which(command[0]) is None:
        raise CompilerError(
            f"compile=True needs a C compiler, and there is no {command[0]!r}: install one (such as gcc, or the extra "
            "'compiler' of vtbdrake), name yours in the environment variable CC, or leave out compile=True."
        )
    # No other user may write there: the files in the folder are executed.
    library.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    name, is_long, begin = library.stem.partition("-")[0], len(source) > LARGE_SOURCE, time.monotonic()
    if is_long:
        _log.warning(
            "compiling %s: %.1f MB of C by %s, which may take about %.0f s of processor time; the library is kept in "
            "%s for the next time",
            *(name, 1e-6 * len(source), command[0], _SECONDS_PER_BYTE * len(source), library.parent),
        )
    with tempfile.TemporaryDirectory() as folder:
        # Compiled here and not at its place: whoever is killed meanwhile leaves no half library there.
        c_file, made = Path(folder) / "function.c", Path(folder) / "function.so"
        c_file.write_text(source, encoding="utf-8")
        returncode, complaint = _run([*command, str(c_file), *map(str, kernels), "-o", str(made), "-lm"], folder)
        if returncode:
            raise CompilerError(f"{shlex.join(command)} failed ({returncode}): {complaint.strip()}")
        contents = made.read_bytes()
        with whole_file(library) as partial:
            partial.write_bytes(contents + _digest(contents))
    if is_long:
        _log.warning("%s is compiled, after %.0f s", name, time.monotonic() - begin)


def _run(command: Sequence[str], folder: str) -> tuple[int, str]:
    """Run a compiler, with its own files in a folder; return its exit code and what it wrote to stderr.

    The processes that it has started end with it: at Ctrl-C, after `LONGEST_COMPILATION`, and at the end of this
    process, by whatever signal. ``cc`` alone would leave the compilation and its files behind.
    """
    watched, end = os.pipe()
    try:
        with subprocess.Popen(
            ["/bin/sh", "-c", _WITH_PARENT, "sh", *command],
            stdin=watched,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "TMPDIR": folder},
            process_group=0,
        ) as process:
            try:
                complaint = process.communicate(timeout=LONGEST_COMPILATION)[1]
                os.write(end, b"\n")
            except BaseException as error:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                if isinstance(error, subprocess.TimeoutExpired):
                    raise CompilerError(
                        f"{command[0]} did not end within {LONGEST_COMPILATION:g} s: compile a smaller part or a "
                        "shorter rollout, or leave out compile=True"
                    ) from None
                raise
    finally:
        os.close(watched)
        os.close(end)
    return process.returncode, complaint
