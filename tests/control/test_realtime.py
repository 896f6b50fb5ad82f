"""Tests that requests of a loop to the operating system are granted or explained, and given back.

The settings belong to a process, so each test has one of its own.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from vtbdrake.control.realtime import RealTime
from vtbdrake.control.runaway import EXIT_CODE

ROOT = Path(__file__).resolve().parents[2]

LATENCY = "/dev/cpu_dma_latency"  # us that a processor may take to wake up

STATE = """
import ctypes, gc, json, os, re, resource, signal, sys
from vtbdrake.control.realtime import RealTime, RealTimeError

def state():
    status = open("/proc/self/status").read()
    return {
        "policy": os.sched_getscheduler(0),
        "priority": os.sched_getparam(0).sched_priority,
        "cpus": sorted(os.sched_getaffinity(0)),
        "locked": int(re.search(r"VmLck:\\s+(\\d+)", status)[1]) > 0,
        "collects": gc.isenabled(),
        "frozen": gc.get_freeze_count() > 0,
        "switch": sys.getswitchinterval(),
        "slack": ctypes.CDLL(None).prctl(30, 0, 0, 0, 0),
        "rttime": list(resource.getrlimit(resource.RLIMIT_RTTIME)),
        "xcpu": str(signal.getsignal(signal.SIGXCPU)),
    }

def tell(**values):
    print(json.dumps(values))

def drop_rights():
    import resource
    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))
    os.setgroups([])
    os.setresgid(65534, 65534, 65534)
    os.setresuid(65534, 65534, 65534)
"""


def told(code: str) -> dict[str, Any]:
    """Run ``code`` in a process of its own, and return what it tells."""
    command = [sys.executable, "-c", STATE + code]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=60)
    return json.loads(result.stdout)


def may_schedule() -> bool:
    return told("r = RealTime(awake=False)\nwith r: pass\ntell(all=all(g.granted for g in r.grants))")["all"]


privileged = pytest.mark.skipif(
    os.geteuid() != 0 or not may_schedule(), reason="needs the right to SCHED_FIFO and mlockall"
)
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can give up rights")


@privileged
def test_settings_hold_inside_and_are_restored() -> None:
    states = told(
        "before = state()\n"
        "with RealTime(priority=42, cpus={before['cpus'][0]}, awake=False) as r: inside = state()\n"
        "tell(before=before, inside=inside, after=state(), granted=[g.granted for g in r.grants])"
    )
    assert states["granted"] == [True] * 7
    assert states["after"] == states["before"]
    inside = states["inside"]
    # Threads and processes that it starts are none of real time.
    assert inside["policy"] == os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    assert inside["priority"] == 42
    assert inside["cpus"] == states["before"]["cpus"][:1]
    assert inside["locked"] and inside["frozen"] and not inside["collects"]
    assert inside["switch"] == pytest.approx(5e-5)


@pytest.mark.skipif(not os.access(LATENCY, os.W_OK), reason=f"needs {LATENCY}")
def test_processors_stay_awake_inside_only() -> None:
    # Others may keep them awake at the same time: what counts is who holds the file.
    seen = told(
        f"def held(): return any(os.path.realpath(fd.path) == '{LATENCY}' for fd in os.scandir('/proc/self/fd'))\n"
        f"def allowed(): return int.from_bytes(open('{LATENCY}', 'rb').read(4), 'little')\n"
        "before = held()\n"
        "with RealTime(priority=None, lock_memory=False): inside, limit = held(), allowed()\n"
        "tell(before=before, inside=inside, limit=limit, after=held())"
    )
    assert seen == {"before": False, "inside": True, "limit": 0, "after": False}


@privileged
def test_settings_are_restored_after_an_exception() -> None:
    states = told(
        "before = state()\n"
        "try:\n"
        "    with RealTime(): raise KeyError('from inside')\n"
        "except KeyError as error: seen = str(error)\n"
        "tell(before=before, after=state(), seen=seen)"
    )
    assert states["after"] == states["before"]
    assert states["seen"] == "'from inside'"


@privileged
def test_threads_do_not_inherit_the_priority() -> None:
    policies = told(
        "import threading\n"
        "found = []\n"
        "with RealTime():\n"
        "    thread = threading.Thread(target=lambda: found.append(os.sched_getscheduler(0)))\n"
        "    thread.start(); thread.join()\n"
        "tell(thread=found[0])"
    )
    assert policies["thread"] == os.SCHED_OTHER


@privileged
def test_nested_settings_restore_outer_ones() -> None:
    states = told(
        "with RealTime(priority=10):\n"
        "    before = state()\n"
        "    with RealTime(priority=20): inside = state()\n"
        "    tell(before=before, inside=inside, after=state())"
    )
    assert states["after"] == states["before"]
    assert states["inside"]["priority"] == 20


RUNAWAY = """
import collections, itertools
from dataclasses import replace
import numpy as np
import vtbdrake.control.realtime
from tests.control.scripted import PERIOD, ScriptedBridge, Servo, ServoScenario
from vtbdrake.control.clock import WallClock
from vtbdrake.control.guards import Guards
from vtbdrake.control.realtime import RealTime, RunawayError
from vtbdrake.control.runtime import Runtime
from vtbdrake.testbed import DpsAlone

class EndlessServo(Servo):
    def _update(self, context, discrete):
        super()._update(context, discrete)
        if context.get_discrete_state(1).value() == 20.0:
            END

class EndlessScenario(ServoScenario):
    def interface(self):
        interface = super().interface()
        return replace(interface, sense=[replace(signal, max_age=60.0) for signal in interface.sense])

    def make_dps(self):
        return EndlessServo()

scenario, clock = EndlessScenario(rate=0.0), WallClock()
bridge = ScriptedBridge(scenario.interface(), clock, lambda t: {"position": [0.0, 0.0], "speed": [0.0, 0.0]})
guards = Guards(scenario.interface(), PERIOD, max_missed=60_000)
runtime = Runtime(DpsAlone(scenario), bridge, period=PERIOD, clock=clock, guards=guards)
runtime.write({"u.target": [0.2, 0.2]})
runtime.cycle()
runtime.switch("real")
"""


@privileged
def test_endless_python_step_is_ended_and_fallback_sent() -> None:
    found = told(
        RUNAWAY.replace("END", "while True: pass") + "before = state()\n"
        "try:\n"
        "    with RealTime(longest_step=0.3, awake=False) as r: runtime.run(cycles=1000)\n"
        "except RunawayError as error: reason = str(error)\n"
        "tell(before=before, after=state(), reason=reason, sent=bridge.sent[-1][1]['velocity'].tolist(),\n"
        "     latched=str(runtime.guards.latched[0]),\n"
        "     commanded=[c['velocity'].tolist() for _, c in bridge.sent if c['velocity'].any()][-1])"
    )
    assert "computed for 0.3 s without waiting" in found["reason"]
    assert found["latched"] == "the loop ended"
    assert found["commanded"] == [1.0, 1.0] and found["sent"] == [0.0, 0.0]
    assert found["after"] == found["before"]


@pytest.mark.slow_cases
@privileged
@pytest.mark.parametrize("main", [False, True])
def test_endless_native_step_ends_the_process(main: bool) -> None:
    run = "    with RealTime(longest_step=0.2, awake=False) as r: runtime.run(cycles=1000)\n"
    code = "import threading\ndef work():\n" + run + ("work()" if main else "threading.Thread(target=work).start()")
    native = RUNAWAY.replace("END", "collections.deque(itertools.repeat(0), maxlen=0)")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", STATE + native + code]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=60)
    assert result.returncode == EXIT_CODE
    assert "in _update" in result.stderr
    assert "computes without end" in result.stderr


@privileged
def test_existing_rttime_limit_is_respected() -> None:
    states = told(
        "resource.setrlimit(resource.RLIMIT_RTTIME, (3_000_000, 4_000_000))\n"
        "before = state()\n"
        "with RealTime(longest_step=5.0, awake=False) as r: refused = [str(g) for g in r.grants if not g.granted]\n"
        "with RealTime(longest_step=2.5, awake=False): inside = state()\n"
        "tell(before=before, refused=refused, inside=inside, after=state())"
    )
    assert states["refused"][0].startswith("steps of 5 s at most: refused (EINVAL, only 4 s are allowed): ")
    assert states["inside"]["rttime"] == [2_500_000, 4_000_000]
    assert states["after"] == states["before"]


@as_root
def test_refusals_contain_reason_and_remedy() -> None:
    states = told(
        "drop_rights()\n"
        "before = state()\n"
        "with RealTime(priority=80) as r: inside = state()\n"
        "tell(before=before, inside=inside, after=state(), lines=str(r).splitlines())"
    )
    lines = {line.split(":")[0]: line for line in states["lines"]}
    assert lines["SCHED_FIFO 80"].startswith("SCHED_FIFO 80: refused (EPERM, Operation not permitted): run as root, or")
    assert "rtprio in /etc/security/limits.conf" in lines["SCHED_FIFO 80"]
    assert lines["locked memory"].startswith("locked memory: refused (ENOMEM, ")
    assert "memlock unlimited" in lines["locked memory"]
    assert lines["processors stay awake"].startswith("processors stay awake: refused (E")
    assert lines["no garbage collection"] == "no garbage collection: granted"
    assert lines["switch interval 50 us"] == "switch interval 50 us: granted"
    assert states["inside"]["slack"] == 1
    assert not states["inside"]["collects"]
    assert states["inside"]["policy"] == os.SCHED_OTHER
    assert states["after"] == states["before"]


@as_root
def test_required_setting_that_is_refused_is_an_error() -> None:
    states = told(
        "drop_rights()\n"
        "before = state()\n"
        "try:\n"
        "    with RealTime(require=True): error = ''\n"
        "except RealTimeError as refusal: error = str(refusal)\n"
        "tell(before=before, after=state(), error=error)"
    )
    assert "SCHED_FIFO 80: refused (EPERM" in states["error"]
    assert states["after"] == states["before"]


@privileged
def test_lost_privileges_do_not_prevent_exit() -> None:
    states = told(
        "before = state()\n"
        "with RealTime() as r:\n"
        "    inside = state()\n"
        "    drop_rights()\n"
        "tell(before=before, inside=inside, after=state())"
    )
    assert states["inside"]["priority"] == 80
    # The flag stays: without rights it cannot be taken back.
    assert states["after"] == {**states["before"], "policy": os.SCHED_OTHER | os.SCHED_RESET_ON_FORK}


def test_unavailable_processors_are_refused() -> None:
    there = sorted(os.sched_getaffinity(0))
    states = told(
        f"with RealTime(priority=None, lock_memory=False, cpus={{{there[0]}, 4095}}) as r: inside = state()\n"
        "tell(inside=inside, line=str(r).splitlines()[0])"
    )
    assert states["inside"]["cpus"] == there
    assert states["line"].startswith(f"processors [{there[0]}, 4095]: refused (EINVAL, only {there} may be used): ")


def test_unrequested_settings_stay_unchanged() -> None:
    states = told(
        "before = state()\n"
        "only = RealTime(priority=None, lock_memory=False, awake=False, collect_garbage=True, switch_interval=None)\n"
        "with only as r: inside = state()\n"
        "tell(before=before, inside=inside, requests=[g.request for g in r.grants])"
    )
    assert states["requests"] == ["timer slack 1 ns"]
    assert states["inside"] == {**states["before"], "slack": 1}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"priority": 0}, "1 to 99, not at 0"),
        ({"priority": 100}, "1 to 99, not at 100"),
        ({"cpus": set()}, "at least one processor"),
        ({"switch_interval": 0.0}, "positive time"),
        ({"longest_step": 0.0}, "above 0 and below 1000 s, not at 0.0 s"),
    ],
)
def test_invalid_arguments_are_rejected(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RealTime(**options)
