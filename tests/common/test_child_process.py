"""Child processes: how they start, what they import, and how they end."""

import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.common.child_functions import (
    accept,
    answer_late,
    compute_in_c,
    echo,
    exit_with,
    fail,
    refuse,
    sleep,
    terminated,
)
from vtbdrake.common.child_process import ChildProcess, ProcessStartError, ending_signals

ROOT = Path(__file__).resolve().parents[2]


def has_ended(pid: int, timeout: float = 60.0) -> bool:
    """Return whether a process, which may be a child of another one, ends within the time."""
    try:
        process = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        return bool(select.select([process], [], [], timeout)[0])
    finally:
        os.close(process)


def test_child_gets_its_arguments_and_answers():
    child = ChildProcess(echo, 1, {"a": None}, name="the echo")
    child.wait_until_ready()
    assert child.connection.recv(1024) == b"(1, {'a': None})"
    child.connection.sendall(b"hello")
    assert child.connection.recv(1024) == b"hello"
    assert child.alive and child.exit_code is None
    assert child.close() == child.exit_code == 0
    assert not child.alive and has_ended(child.pid)


def test_requests_are_answered_line_by_line():
    child = ChildProcess(echo, name="the echo")
    child.wait_until_ready()
    assert child.request(b"a\n", timeout=60.0) == b"()a\n"
    assert child.request(b"b\n", timeout=60.0) == b"b\n"
    with pytest.raises(TimeoutError):
        child.request(b"no line", timeout=0.1)
    child.kill()
    with pytest.raises(OSError):
        child.request(b"c\n", timeout=60.0)
    child.close()


def test_answer_that_comes_too_late_is_passed_over():
    child = ChildProcess(answer_late, name="the thinker")
    child.wait_until_ready()
    with pytest.raises(TimeoutError):
        child.request(b"first\n", timeout=0.01)
    assert child.request(b"second\n", timeout=60.0) == b"second\n"
    child.close()


def test_large_arguments_do_not_block_the_start():
    child = ChildProcess(sleep, bytes(50_000_000), name="the sleeper")
    child.kill()
    child.close()


def test_functions_of_the_main_module_are_sent():
    program = """
from vtbdrake.common.child_process import ChildProcess
def answer(connection): connection.sendall(b"local")
child = ChildProcess(answer, name="the child")
print(child.connection.recv(100), child.close())
"""
    run = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert run.stdout == "b'local' 0\n"


def test_sockets_are_handed_over():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        child = ChildProcess(accept, name="the server", sockets=[listener])
        child.wait_until_ready()
        with socket.create_connection(listener.getsockname()) as client:
            assert client.recv(100) == b"accepted"
    assert child.close() == 0


@pytest.mark.parametrize(
    ("function", "arguments", "message"),
    [
        (refuse, (), "^no robot is connected$"),
        (fail, (), r"^the child did not start \(exit code 1\): see its output above$"),
        (exit_with, (7,), r"^the child did not start \(exit code 7\)"),
    ],
)
def test_child_that_does_not_start_says_why(function, arguments, message, capfd):
    child = ChildProcess(function, *arguments, name="the child")
    with pytest.raises(ProcessStartError, match=message):
        child.wait_until_ready()
    assert child.close() == (arguments or (1,))[0]
    assert (function is fail) == ("ArithmeticError: a failure of the test" in capfd.readouterr().err)


def test_child_that_is_not_ready_in_time_is_an_error():
    child = ChildProcess(echo, name="the child")
    os.kill(child.pid, signal.SIGSTOP)
    with pytest.raises(ProcessStartError, match=rf"the child \(process {child.pid}\) was not ready within 0.1 s"):
        child.wait_until_ready(0.1)
    child.kill()
    child.close()


def test_child_that_does_not_end_is_killed(caplog):
    child = ChildProcess(sleep, name="the sleeper")
    child.wait_until_ready()
    assert child.close(timeout=0.2) == -signal.SIGKILL
    assert f"the sleeper (process {child.pid}) has not ended in time, and is killed" in caplog.text


def test_what_a_killed_child_has_sent_can_be_read():
    child = ChildProcess(echo, name="the echo")
    child.wait_until_ready()
    select.select([child.connection], [], [])
    assert child.kill() == -signal.SIGKILL
    assert child.connection.recv(1024) == b"()"
    assert child.connection.recv(1024) == b""
    assert child.close() == -signal.SIGKILL


@pytest.mark.parametrize(("grace", "function"), [(0.0, "sleep"), (600.0, "echo")])
def test_child_ends_when_its_parent_is_killed(grace, function):
    """It ends although it computes, if there is no grace; else when its function returns."""
    program = f"""
from tests.common.child_functions import {function}
from vtbdrake.common.child_process import ChildProcess
child = ChildProcess({function}, name="the child", grace={grace})
child.wait_until_ready()
print(child.pid, flush=True)
child.wait()
"""
    command = [sys.executable, "-c", program]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        parent.kill()
    assert has_ended(pid)


def test_child_ignores_interrupts():
    child = ChildProcess(echo, name="the echo")
    child.wait_until_ready()
    os.kill(child.pid, signal.SIGINT)
    child.connection.sendall(b"!")
    answer = b""
    while not answer.endswith(b"!"):
        answer += child.connection.recv(1024)
    assert child.close() == 0


# -- what children import

PROGRAM = """
import os, sys
from pathlib import Path
import vtbdrake, mine
os.chdir(sys.argv[1])
{changed}
from vtbdrake.common.child_process import ChildProcess
child = ChildProcess(mine.tell, name="the child")
print(child.connection.recv(1000).decode(), child.close())
"""
MINE = "import vtbdrake\ndef tell(connection): connection.sendall(vtbdrake.__file__.encode())\n"


@pytest.mark.parametrize(
    ("changed", "twice"),
    [
        ("", ("vtbdrake", "mine")),
        ("sys.path.insert(0, sys.argv[1])", ("vtbdrake",)),
        ("sys.path.insert(0, Path(sys.argv[1]))", ("vtbdrake", "mine")),  # Imports ignore what is not a string.
    ],
)
def test_child_imports_what_its_parent_imports(changed: str, twice: Sequence[str], tmp_path: Path) -> None:
    """The program begins in directory a, with its vtbdrake and its modules, and goes to b, which has others."""
    directory, other = tmp_path / "a", tmp_path / "b"
    directory.mkdir()
    (directory / "vtbdrake").symlink_to(ROOT / "vtbdrake")
    (directory / "mine.py").write_text(MINE)
    for name in twice:
        (other / name).mkdir(parents=True)
        (other / name / "__init__.py").write_text("raise ImportError('of another checkout')\n")
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM.format(changed=changed), str(other)],
        cwd=directory,
        env={},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout == f"{directory / 'vtbdrake/__init__.py'} 0\n"


GROUP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def test_child_outlives_what_is_sent_to_its_group() -> None:
    """Signals come from its first instant on, before it is ready and afterwards."""
    child = ChildProcess(echo, name="the echo")
    for number in GROUP_SIGNALS:
        os.kill(child.pid, number)
    child.wait_until_ready()
    for number in GROUP_SIGNALS:
        os.kill(child.pid, number)
    assert child.request(b"still here\n", timeout=60.0) == b"()still here\n"
    assert child.close() == 0
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, ()) & set(GROUP_SIGNALS)


def test_processes_of_a_child_can_be_terminated() -> None:
    child = ChildProcess(terminated, name="the starter")
    child.wait_until_ready()
    child.connection.sendall(b"x")
    child.connection.settimeout(60.0)
    assert child.connection.recv(100) == b"(-15, -15)"
    assert child.close() == 0


@pytest.mark.parametrize("ignored", [set(), {signal.SIGHUP}])
def test_ending_signals_are_handled_in_the_block_only_unless_they_are_ignored(ignored: set[signal.Signals]) -> None:
    numbers = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
    shell = {n: signal.signal(n, signal.SIG_IGN if n in ignored else signal.default_int_handler) for n in numbers}
    try:
        before = [signal.getsignal(number) for number in numbers]
        received: list[int] = []
        with ending_signals(lambda number, _: received.append(number)):
            for number in numbers:
                signal.raise_signal(number)
        assert received == [number for number in numbers if number not in ignored]
        assert [signal.getsignal(number) for number in numbers] == before
    finally:
        for number, handler in shell.items():
            signal.signal(number, handler)


def test_child_that_computes_in_c_ends_with_its_connection():
    child = ChildProcess(compute_in_c, name="a child", grace=0.1)
    child.wait_until_ready()
    child.connection.close()
    assert child.wait(60.0) == 1
