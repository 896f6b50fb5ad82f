"""A testbed that is dropped is freed: its systems do not hold each other for ever."""

import gc
import importlib
import pkgutil
import threading
import time
import weakref
from types import SimpleNamespace

import pytest
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import LeafSystem

import vtbdrake.components
import vtbdrake.testbed
import vtbdrake_diagrams
from tests.lcm.iiwa import IiwaScenario
from tests.testbeds import PendulumScenario
from vtbdrake.drake_workarounds import step_watch
from vtbdrake.state import AddressedSystem

for package in (vtbdrake.components, vtbdrake.testbed, vtbdrake_diagrams):
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)


def _derived(kind):
    for child in kind.__subclasses__():
        yield child
        yield from _derived(child)


def test_our_systems_have_no_dict_of_their_own():
    """With pybind11, the collector visits it twice and takes the system for one that is used from elsewhere."""
    ours = [kind for kind in _derived(LeafSystem) if kind.__module__.split(".")[0] in ("vtbdrake", "vtbdrake_diagrams")]
    assert len(ours) > 10
    assert [kind for kind in ours if not issubclass(kind, AddressedSystem) and "__slots__" not in vars(kind)] == []


def _collect():
    for _ in range(20):  # A plant that a system of the Diagram owns is freed after it.
        if not gc.collect():
            return


def _plants():
    """All plants that are alive, by identity; who holds the result keeps them so."""
    _collect()
    return {id(thing): thing for thing in gc.get_objects() if isinstance(thing, MultibodyPlant)}


@pytest.mark.slow_cases
@pytest.mark.parametrize("make", [PendulumScenario, IiwaScenario])
def test_a_dropped_testbed_is_freed(make):
    before = _plants()
    for _ in range(3):
        testbed = make().build()
        testbed.variables()
        testbed.simulator(testbed.default_context()).AdvanceTo(0.02)
    assert _plants().keys() > before.keys()
    del testbed
    assert _plants().keys() == before.keys()


@pytest.mark.parametrize("address", ["real.act.torque", "real.sense.joint_state", "plant.state", "dps.torque"])
def test_a_context_that_was_read_is_freed(address):
    testbed = PendulumScenario().build()
    context = testbed.default_context()
    testbed.read(context, address)
    reference = weakref.ref(context)
    del context
    gc.collect()
    assert reference() is None


def test_a_testbed_that_was_looked_at_is_freed_while_the_watcher_rests(monkeypatch):
    looked, resting, rested = threading.Event(), threading.Event(), threading.Event()
    look = step_watch.StepWatch.look

    def rest(seconds):
        time.sleep(0.01)
        if looked.is_set():
            resting.set()
            rested.wait(60.0)

    def look_once(self):
        look(self)
        looked.set()

    monkeypatch.setattr(step_watch, "time", SimpleNamespace(sleep=rest))
    monkeypatch.setattr(step_watch.StepWatch, "look", look_once)
    testbed = PendulumScenario().build()
    plant = weakref.ref(testbed.plant)
    try:
        with step_watch.StepWatch(Simulator(testbed.diagram, testbed.default_context()), str):
            assert looked.wait(60.0)
        assert resting.wait(60.0)
        del testbed
        _collect()
        assert plant() is None
    finally:
        rested.set()
