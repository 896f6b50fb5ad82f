"""Processes that end without destroying what they have imported."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.one_python

BEGIN = """
import atexit, sys, threading, time
from vtbdrake.common.quick_exit import quick_exit
class Kept:
    def __del__(self): print("destroyed")
kept = Kept()
atexit.register(print, "at exit")
"""


def ended(program: str, folder: Path) -> tuple[int, list[str]]:
    script = folder / "program.py"
    script.write_text(BEGIN + program)
    done = subprocess.run([sys.executable, script], capture_output=True, text=True)
    return done.returncode, done.stdout.split("\n")[:-1]


def test_functions_of_atexit_are_called_and_nothing_is_destroyed(tmp_path: Path) -> None:
    assert ended("print('done', end=' '); quick_exit(3)", tmp_path) == (3, ["done at exit"])


def test_threads_are_waited_for_as_at_any_other_end(tmp_path: Path) -> None:
    program = "go = threading.Event(); threading.Thread(target=lambda: (go.wait(), print('thread'))).start()\n"
    program += "quick_exit(3); print('later'); go.set()"
    assert ended(program, tmp_path) == (0, ["later", "thread", "at exit", "destroyed"])


def test_a_stream_that_nobody_reads_does_not_hide_the_end(tmp_path: Path) -> None:
    script = tmp_path / "program.py"
    script.write_text(BEGIN + "sys.stdout.close(); quick_exit(3)")
    done = subprocess.run([sys.executable, script], capture_output=True, text=True)
    assert done.returncode != 3 and done.stdout == ""
