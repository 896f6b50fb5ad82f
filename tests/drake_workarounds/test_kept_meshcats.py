"""Tests that no Meshcat ends in another thread than its own, where Drake aborts the process."""

import gc
import subprocess
import sys
from urllib.error import URLError
from urllib.request import urlopen

import pytest
from pydrake.geometry import StartMeshcat

from tests.testbeds import PendulumScenario
from vtbdrake.visualization import make_meshcat


def first_quick(ways):
    """Return the cases: each takes a process of its own, so that all but the first are slow."""
    first, *others = ways
    return [first, *(pytest.param(way, marks=pytest.mark.slow) for way in others)]


BEGIN = """
import gc
import os
import threading

from pydrake.geometry import StartMeshcat
from tests.testbeds import PendulumScenario
from vtbdrake.visualization import make_meshcat

gc.disable()
"""
WAYS = {
    "a testbed": "PendulumScenario().build(meshcat=make_meshcat())",
    "a testbed that draws into a Meshcat of Drake's": "PendulumScenario().build(meshcat=StartMeshcat())",
    "a traceback": """
def fail():
    meshcat = make_meshcat()
    try:
        raise ValueError
    except ValueError as error:
        kept = error
fail()
""",
}
END = """
collector = threading.Thread(target=gc.collect)
collector.start()
collector.join()
if not os.fork():
    make_meshcat()
    os._exit(0)
print(os.wait()[1], flush=True)
"""


@pytest.mark.parametrize("way", first_quick(WAYS))
def test_garbage_collector_of_another_thread_ends_no_meshcat(way):
    program = [sys.executable, "-c", BEGIN + WAYS[way] + END]
    done = subprocess.run(program, capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stdout) == (0, "0\n"), done.stderr


DEATH = """
from tests.meshcats import kill, kill_own
from tests.testbeds import PendulumScenario
from vtbdrake.visualization import make_meshcat

meshcat = make_meshcat()
"""
ENDS = {
    # While it dies, or after that.
    "at the end of the process": "kill(meshcat.web_url())",
    "with the next one": "kill(meshcat.web_url()); del meshcat; make_meshcat()",
    "after a simulation that drew into it": """
kill_own(meshcat)
try:
    testbed = PendulumScenario().build(meshcat=meshcat)
    testbed.simulator(testbed.default_context()).Initialize()
except RuntimeError as error:
    assert "exited unexpectedly" in str(error)
else:
    raise AssertionError
""",
}


@pytest.mark.slow
@pytest.mark.parametrize("way", first_quick(ENDS))
def test_dead_meshcat_holds_up_no_process(way):
    program = [sys.executable, "-c", DEATH + ENDS[way] + "\nprint('done', flush=True)"]
    done = subprocess.run(program, capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stdout) == (0, "done\n"), done.stderr


def answers(url):
    try:
        return urlopen(url, timeout=10.0).status == 200
    except URLError:
        return False


def test_meshcat_that_nothing_uses_ends_with_the_next_one():
    meshcat = make_meshcat()
    testbed = PendulumScenario().build(meshcat=meshcat)
    url = meshcat.web_url()
    del meshcat
    make_meshcat()
    assert answers(url)  # It is drawn into.
    del testbed
    gc.collect()
    make_meshcat()
    assert not answers(url)


def test_meshcat_of_the_user_stays():
    meshcat = StartMeshcat()
    PendulumScenario().build(meshcat=meshcat)
    gc.collect()
    make_meshcat()
    assert answers(meshcat.web_url())
