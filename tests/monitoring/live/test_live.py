"""Live values: a running DPS is set, read and watched from outside without being disturbed."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from types import FrameType, SimpleNamespace
from typing import Any

import lcm
import numpy as np
import pytest

from tests.control.scripted import PERIOD, ScriptedBridge, ServoScenario
from tests.monitoring.live.rig import PATIENCE, Rig, moving, served
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.runtime import Runtime
from vtbdrake.lcm.connections import TcpqConnection
from vtbdrake.lcm.hub import Hub, client_name
from vtbdrake.monitoring.live import client as client_module
from vtbdrake.monitoring.live.client import LiveClient, LiveError, LiveTimeoutError, LiveWatch, watch
from vtbdrake.monitoring.live.live_server import MAX_WAITING
from vtbdrake.monitoring.live.service import loop_status
from vtbdrake.testbed import DpsAlone

# Enough to read everything in one cycle, even on a busy computer.
AMPLE = {"budget": 10.0, "longest": 10.0}

# Timeouts in seconds; on a busy computer, the first ones may be too short for what precedes the error.
LONGER_AND_LONGER = [0.5 * 2**k for k in range(8)]


@pytest.fixture(scope="module")
def hub() -> Iterator[Hub]:
    with Hub(port=0) as running:
        yield running


@pytest.fixture(scope="module")
def shared() -> Iterator[Rig]:
    """Yield a rig on a bus of its own for tests that change nothing."""
    with Hub(port=0) as bus, served(bus.url, **AMPLE) as (rig, _):
        yield rig


def asked(url: str, method: str, *arguments: Any) -> Any:
    with LiveClient(url, timeout=PATIENCE) as client:
        return getattr(client, method)(*arguments)


def watched(url: str, addresses: list[str], count: int, **options: Any) -> list[tuple[float, dict[str, Any]]]:
    return list(islice(watch(url, addresses, timeout=PATIENCE, **options), count))


# -- status


def test_status_tells_switches_ages_and_faults(hub: Hub) -> None:
    with served(hub.url, **AMPLE) as (rig, _):
        status = rig.during(asked, hub.url, "status")
        assert status.positions["act"] == {"velocity": "real"}
        assert set(status.positions["sense"].values()) == {"real"}
        assert (status.reasons, status.latched) == ([], [])
        assert set(status.ages) == set(rig.bridge.sensed)
        assert all(0.0 <= age <= 2 * PERIOD for age in status.ages.values())
        rig.bridge.sensors = lambda now: {}
        rig.until(lambda: bool(rig.runtime.guards.latched))
        latched = [fault.reason for fault in rig.runtime.guards.latched]
        for reason in ("one more", "and one more"):
            rig.runtime.guards.latch(reason, rig.runtime.clock.now(), {})
        status = rig.during(asked, hub.url, "status")
        assert status.latched == latched
        assert [reason for reason, _ in status.faults[:3]] == ["and one more", "one more", latched[-1]]
        assert all(age >= 0.0 for _, age in status.faults)
        assert max(status.ages.values()) > 2 * PERIOD


def test_status_tells_why_nothing_is_commanded_yet(hub: Hub) -> None:
    scenario = ServoScenario()
    clock = SimulatedClock()
    bridge = ScriptedBridge(scenario.interface(), clock, moving)
    runtime = Runtime(DpsAlone(scenario), bridge, period=PERIOD, clock=clock, blocked_by=lambda: "the brakes are on")
    status = loop_status(runtime)
    assert status.positions["act"] == {"velocity": "idle"}
    assert any("the brakes are on" in reason for reason in status.reasons)
    assert all(age == np.inf for age in status.ages.values())


# -- set and get


def test_service_waits_for_a_full_hub(capfd: pytest.CaptureFixture[str]) -> None:
    with Hub(port=0, max_clients=2) as bus:
        others = [TcpqConnection(bus.url, {"A": lambda *_: None}, PATIENCE) for _ in range(2)]
        with served(bus.url) as (rig, _):
            rig.until(lambda: bus.statistics().disconnected.get("too many", 0) >= 2)
            for other in others:
                other.close()
            rig.until(lambda: bus.statistics().clients == 1)
            assert list(rig.during(asked, bus.url, "get", ["dps.gain"])) == ["dps.gain"]
    told = capfd.readouterr().err
    assert "Traceback" not in told and told.count("the live service waits for the bus") == 1


def test_clients_take_turns_on_protected_channel() -> None:
    with Hub(port=0, protect=["VTB_SET"], lease=0.1) as bus, served(bus.url) as (rig, _):
        with LiveClient(bus.url, timeout=PATIENCE) as first, LiveClient(bus.url, timeout=PATIENCE) as second:
            rig.during(first.set, {"dps.gain": 3.0})
            rig.during(second.set, {"dps.gain": 4.0})
            rig.during(first.set, {"dps.gain": 5.0})
        rig.during(asked, bus.url, "set", {"dps.gain": 6.0})
        assert rig.during(asked, bus.url, "get", ["dps.gain"]) == {"dps.gain": 6.0}
        assert bus.statistics().protected["VTB_SET"].taken >= 2


def test_owner_of_protected_channel_is_named(hub: Hub) -> None:
    with Hub(port=0, protect=["VTB_SET"], lease=300.0) as bus:
        owner = lcm.LCM(bus.url)
        owner.publish("VTB_SET", b"")

        def reason(timeout: float) -> str:
            with LiveClient(bus.url, timeout=timeout) as client, pytest.raises(LiveTimeoutError) as caught:
                client.set({"dps.gain": 3.0})
            return str(caught.value)

        told = f"lets only {client_name(owner.fileno())} publish on VTB_SET"
        assert any(told in reason(timeout) for timeout in LONGER_AND_LONGER)


@pytest.mark.slow_cases
@pytest.mark.parametrize("noise", [b"", b"[1]", b"no", b"\xff", b"[" * 5000, b'{"id": 3}'])
def test_noise_is_not_taken_for_an_answer(hub: Hub, noise: bytes) -> None:
    bus = lcm.LCM(hub.url)
    with served(hub.url, **AMPLE) as (rig, _), LiveClient(hub.url, timeout=PATIENCE) as client:
        for channel in ("VTB_GET_ANSWER", "VTB_WATCH_ANSWER", "VTB_GET", "VTB_SET", "VTB_WATCH"):
            bus.publish(channel, noise)
        assert list(rig.during(client.get, ["dps.gain"])) == ["dps.gain"]
        with LiveWatch(hub.url, ["dps.ticks"], timeout=PATIENCE) as live:
            bus.publish("VTB_WATCH_ANSWER", noise)
            rig.during(live.wait, 3, timeout=PATIENCE)


@contextmanager
def impostor(url: str, channel: str, answers: list[tuple[str, dict[str, Any]]]) -> Iterator[None]:
    """Answer each request on a channel with the right id; ``ID`` in a channel is replaced by it."""
    bus, stop = lcm.LCM(url), threading.Event()

    def answer(_: str, data: bytes) -> None:
        id = json.loads(data)["id"]
        for where, content in answers:
            bus.publish(where.replace("ID", id), json.dumps({"id": id, **content}).encode())

    def serve() -> None:
        while not stop.is_set():
            bus.handle_timeout(20)

    bus.subscribe(channel, answer)
    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def test_end_of_the_dps_is_an_answer(hub: Hub) -> None:
    with (
        impostor(hub.url, "VTB_SET", [("VTB_SET_ANSWER", {"ended": True})]),
        pytest.raises(LiveError, match="ended"),
    ):
        asked(hub.url, "set", {"a": 1.0})


NO_VALUES = [None, 3, [], {}, {"b": 1.0}, *({"a": value} for value in ("1", None, True, {}, [[1.0], 2.0], [None]))]


@pytest.mark.parametrize(
    ("method", "arguments", "answer"),
    [
        *(("get", (["a"],), {"ok": True, "values": values}) for values in NO_VALUES),
        ("get", (["a"],), {"ok": True}),
        ("get", (["a"],), {"values": {"a": 1.0}}),
        ("get", (["a"],), {"error": 3}),
        ("set", ({"a": 1.0},), {"ok": False}),
        ("set", ({"a": 1.0},), {"error": {"a": 1}}),
        ("reset", (), {"ok": True}),
        ("reset", (), {"ok": True, "released": "all"}),
        ("reset", (), {"ok": True, "released": [3]}),
    ],
)
def test_invalid_answer_raises_live_error(
    hub: Hub, method: str, arguments: tuple[Any, ...], answer: dict[str, Any]
) -> None:
    channel = f"VTB_{method.upper()}"
    with impostor(hub.url, channel, [(f"{channel}_ANSWER", answer)]), pytest.raises(LiveError) as caught:
        asked(hub.url, method, *arguments)
    assert str(answer.get("error", "is not from a DPS of vtbdrake")) in str(caught.value)


@pytest.mark.parametrize(
    "sample",
    [
        *({"time": 1.0, "since": 1.0, "values": values} for values in NO_VALUES),
        {"since": 1.0, "values": {"a": 1.0}},
        {"time": "now", "since": 1.0, "values": {"a": 1.0}},
        {"time": 1.0, "values": {"a": 1.0}},
        {"error": 3},
    ],
)
def test_invalid_sample_raises_live_error(hub: Hub, sample: dict[str, Any]) -> None:
    answers = [("VTB_WATCH_ANSWER", {"ok": True}), ("VTB_WATCHED/ID", sample)]
    with impostor(hub.url, "VTB_WATCH", answers):
        with pytest.raises(LiveError):
            watched(hub.url, ["a"], 1)
        with LiveWatch(hub.url, ["a"], timeout=PATIENCE) as live, pytest.raises(LiveError):
            live.wait(1, timeout=PATIENCE)


def test_set_values_take_effect(hub: Hub) -> None:
    with served(hub.url) as (rig, _):
        rig.during(asked, hub.url, "set", {"dps.gain": 3.0, "u.target": [0.2, -0.1]})
        rig.runtime.cycle()
        [(k, change)] = [(k, change) for k, cycle in enumerate(rig.cycles) for change in cycle.changes[:1] if k > 1]
        assert change == ("write", {"dps.gain": 3.0, "u.target": [0.2, -0.1]})
        position = np.array(rig.cycles[k].fed["position"])
        assert np.array_equal(rig.cycles[k].actuation["velocity"], 3.0 * (np.array([0.2, -0.1]) - position))
        assert not np.array_equal(rig.cycles[k - 1].actuation["velocity"], rig.cycles[k].actuation["velocity"])


def test_get_returns_present_values(shared: Rig) -> None:
    found = shared.during(asked, shared.url, "get", ["dps.gain", "u.target", "u.target[1]", "real.act.velocity"])
    assert (found["dps.gain"], found["u.target[1]"]) == (5.0, 0.0)
    assert np.array_equal(found["u.target"], [0.0, 0.0])
    assert any(np.array_equal(found["real.act.velocity"], cycle.actuation.get("velocity")) for cycle in shared.cycles)


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"dps.gian": 1.0}, "no variable and no port 'dps.gian'; did you mean dps.gain or"),
        ({"dps.gain": 1.0, "dps.nothing[3]": 1.0}, "'dps.nothing[3]'"),
        ({"dps.gain": -1.0}, "must lie in"),
        ({"dps.gain": [1.0, 2.0]}, "shape"),
        ({"u.target": [[1.0], [2.0, 3.0]]}, ""),
        ({"dps.velocity": 1.0, "dps.gain": float("nan")}, "the value of dps.gain must be a finite number"),
        ({"time": 1.0}, "time is not written"),
        ({"real.act.velocity": [1.0, 1.0]}, "real.act.velocity is a port"),
    ],
)
def test_impossible_set_is_rejected(shared: Rig, values: dict[str, Any], reason: str) -> None:
    with pytest.raises(LiveError) as error:
        shared.during(asked, shared.url, "set", values)
    assert reason in str(error.value)
    assert not any(change.kind == "write" for cycle in shared.cycles for change in cycle.changes)


def test_misspelt_address_is_answered_without_loading_drake(hub: Hub) -> None:
    with served(hub.url) as (rig, service):
        with pytest.raises(LiveError, match=r"did you mean dps\.gain"):
            rig.during(asked, hub.url, "get", ["dps.gian"])
        assert "libdrake" not in Path(f"/proc/{service.pid}/maps").read_text()


def test_failed_drake_assertion_is_an_answer(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    def write(values: dict[str, Any]) -> None:
        raise SystemExit("Failure at diagram.cc:1: condition 'it holds' failed.")

    with served(hub.url) as (rig, _):
        monkeypatch.setattr(rig.runtime, "write", write)
        with pytest.raises(LiveError, match="condition 'it holds' failed"):
            rig.during(asked, hub.url, "set", {"dps.gain": 3.0})
        monkeypatch.undo()
        rig.during(asked, hub.url, "set", {"dps.gain": 3.0})


def test_garbage_is_counted_and_harmless(hub: Hub) -> None:
    bus, answers = lcm.LCM(hub.url), []
    bus.subscribe("VTB_SET_ANSWER", lambda _, data: answers.append(json.loads(data)))
    with served(hub.url) as (rig, service):
        rig.during(asked, hub.url, "get", ["dps.gain"])  # The worker process listens.
        bus.publish("VTB_RESET", b'{"id": "me", "reset": 1}')
        for data in (b"", b"\x00\xff", b" " * 100_000, b'{"id": "me", "set": {"x": Infinity}}', b'{"id": "me"}'):
            bus.publish("VTB_SET", data)
        rig.until(lambda: service.rejected == 6)
        while len(answers) < 5:
            assert bus.handle_timeout(round(1e3 * PATIENCE))
        assert [answer["id"] for answer in answers] == ["", "", "", "me", "me"]
        assert all(answer["error"] for answer in answers)
        assert rig.during(asked, hub.url, "get", ["dps.gain"]) == {"dps.gain": 5.0}
    assert rig.runtime.guards.latched == ()


def test_flood_costs_one_request_per_cycle(hub: Hub) -> None:
    bus, answers = lcm.LCM(hub.url), []
    with served(hub.url) as (rig, _):
        rig.during(asked, hub.url, "get", ["dps.gain"])
        bus.subscribe("VTB_SET_ANSWER", lambda _, data: answers.append(json.loads(data))).set_queue_capacity(0)
        before = len(rig.cycles)
        for k in range(100):
            bus.publish("VTB_SET", json.dumps({"id": f"me{k}", "set": {"dps.gain": k}}).encode())
        # The server rejects those that it does not pass on to the loop.
        while len(answers) < 100 - MAX_WAITING:
            assert bus.handle_timeout(round(1e3 * PATIENCE))
        assert all("requests are waiting" in answer["error"] for answer in answers)
        rig.until(lambda: sum(len(cycle.changes) for cycle in rig.cycles[before:]) == MAX_WAITING)
    assert all(len(cycle.changes) <= 1 for cycle in rig.cycles[before:])


def test_set_command_respects_the_rate_limit(hub: Hub) -> None:
    rate = 2.0
    with served(hub.url, rate=rate) as (rig, _):
        rig.during(asked, hub.url, "set", {"u.target": [0.2, -0.2], "dps.gain": 4.0})
        rig.until(lambda: abs(rig.sent[-1][0]) > 0.1)
    assert rig.runtime.guards.latched == ()
    assert np.abs(np.diff(rig.sent, axis=0)).max() <= rate * PERIOD * (1.0 + 1e-9)


@pytest.mark.parametrize("timeout", [0.0, -1.0, float("nan")])
def test_timeout_must_be_positive(hub: Hub, timeout: float) -> None:
    for begin in (LiveClient, lambda url, timeout: LiveWatch(url, ["dps.gain"], timeout=timeout)):
        with pytest.raises(ValueError, match="the timeout must be a positive number of seconds, not"):
            begin(hub.url, timeout=timeout)
    with pytest.raises(ValueError, match="the timeout must be a positive number of seconds, not"):
        next(watch(hub.url, ["dps.gain"], timeout=timeout))


def test_lease_must_be_a_number(hub: Hub) -> None:
    with pytest.raises(LiveError, match="lease must be 0.1 to 60 s, not nan"):
        next(watch(hub.url, ["dps.gain"], lease=float("nan"), timeout=0.1))


def test_missing_service_is_a_timeout(hub: Hub) -> None:
    with LiveClient(hub.url, timeout=0.1) as client, pytest.raises(LiveTimeoutError, match="no answer"):
        client.get(["dps.gain"])


def test_latch_is_released_when_its_cause_is_over(hub: Hub) -> None:
    with served(hub.url, **AMPLE) as (rig, _):
        assert rig.during(asked, hub.url, "reset") == []
        rig.during(asked, hub.url, "set", {"dps.trouble": 1.0})
        rig.until(lambda: rig.runtime.guards.latched != ())
        with pytest.raises(LiveError, match="the DPS raised"):
            rig.during(asked, hub.url, "reset")
        assert rig.runtime.guards.latched != ()
        rig.during(asked, hub.url, "set", {"dps.trouble": 0.0})
        (reason,) = rig.during(asked, hub.url, "reset")
        assert reason.startswith("the DPS raised")
        rig.runtime.cycle()
        assert rig.cycles[-1].verdict.ok
        assert [change.kind for cycle in rig.cycles for change in cycle.changes].count("reset") == 1


# -- watch


def test_watched_values_match_their_cycle(shared: Rig) -> None:
    seen = shared.during(watched, shared.url, ["dps.velocity", "real.act.velocity", "dps.ticks"], 50)
    by_time = {cycle.time: cycle.actuation for cycle in shared.cycles}
    for t, values in seen:
        assert np.array_equal(values["dps.velocity"], by_time[t]["velocity"])
        assert np.array_equal(values["real.act.velocity"], by_time[t]["velocity"])
    assert np.diff([values["dps.ticks"] for _, values in seen]).tolist() == [1.0] * 49


def test_watch_has_a_period_in_cycles(shared: Rig) -> None:
    seen = shared.during(watched, shared.url, ["dps.ticks"], 5, every=7)
    assert np.diff([values["dps.ticks"] for _, values in seen]).tolist() == [7.0] * 4


def test_values_beyond_the_budget_take_turns(hub: Hub) -> None:
    addresses = ["dps.ticks", "dps.gain", "dps.velocity", "u.target"]
    bus, seen = lcm.LCM(hub.url), []
    bus.subscribe("VTB_WATCHED/me", lambda _, data: seen.append(json.loads(data)))
    with served(hub.url, budget=1e-9) as (rig, service):
        rig.during(asked, hub.url, "get", ["dps.gain"])
        bus.publish("VTB_WATCH", json.dumps({"id": "me", "watch": addresses}).encode())
        rig.until(lambda: service.watches == 1)
        rig.until(lambda: bus.handle_timeout(0) > 0 and len(seen) >= 5)
    # One value a cycle, so a round takes four cycles.
    assert all(m["time"] - m["since"] == pytest.approx(3 * PERIOD) for m in seen)
    assert all(m["values"]["dps.ticks"] == round(m["since"] / PERIOD) for m in seen)


@pytest.mark.slow
def test_watches_beyond_the_budget_take_turns(hub: Hub) -> None:
    with served(hub.url, budget=1e-9) as (rig, service):
        with LiveWatch(hub.url, ["dps.ticks", "dps.gain"], timeout=PATIENCE) as first:
            rig.until(lambda: service.watches == 1)
            seen = rig.during(watched, hub.url, ["u.target", "dps.velocity"], 5)
            rig.during(first.wait, 5, timeout=PATIENCE)
        assert len(seen) == 5


def test_slow_value_is_not_read_again(hub: Hub) -> None:
    with served(hub.url, budget=1e-9, longest=1e-9) as (rig, service):
        with pytest.raises(LiveError, match=r"reading dps.ticks takes .* ms"):
            rig.during(watched, hub.url, ["dps.ticks"], 1)
        assert service.watches == 0


@pytest.mark.parametrize(
    ("address", "reason"),
    [("dps.velocty", "did you mean dps.velocity"), ("u.target[2]", "no variable"), ("dps", "no variable")],
)
def test_watch_of_unknown_address_is_rejected(shared: Rig, address: str, reason: str) -> None:
    with pytest.raises(LiveError, match=reason):
        shared.during(watched, shared.url, ["dps.ticks", address], 1)


def test_watch_period_beyond_timeout_is_reported(hub: Hub) -> None:
    def reason(timeout: float) -> str:
        with pytest.raises(LiveTimeoutError) as caught:
            list(watch(hub.url, ["dps.ticks"], every=1_000_000_000, timeout=timeout))
        return str(caught.value)

    with served(hub.url, **AMPLE) as (rig, _):
        rig.during(asked, hub.url, "get", ["dps.gain"])
        told = "or 1000000000 cycles take longer"
        assert rig.during(lambda: any(told in reason(timeout) for timeout in LONGER_AND_LONGER))


def test_the_time_between_two_values_is_the_callers(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    real, ahead = time.monotonic, [0.0]
    monkeypatch.setattr(client_module, "time", SimpleNamespace(monotonic=lambda: real() + ahead[0]))

    def take_long() -> list[float]:
        taken = []
        for now, _ in islice(watch(hub.url, ["dps.ticks"], timeout=PATIENCE), 30):
            taken.append(now)
            ahead[0] += 10.0 * PATIENCE
        return taken

    with served(hub.url, **AMPLE) as (rig, _):
        assert len(rig.during(take_long)) == 30


def test_wait_ends_with_its_watch(hub: Hub) -> None:
    """Also if the thread of the watch still takes its time to end."""
    released, held = threading.Event(), list[bool]()

    def hold(frame: FrameType, event: str, _: object) -> None:
        if (event, frame.f_code) == ("return", threading.Thread.run.__code__):
            held.append(released.wait(20.0))

    threading.setprofile(hold)
    try:
        live = LiveWatch(hub.url, ["dps.ticks"], timeout=0.1)
    finally:
        threading.setprofile(None)
    with pytest.raises(LiveTimeoutError, match="no answer on"):
        live.wait(1, timeout=30.0)
    released.set()
    live.close()
    assert held == [True]


def test_watch_ends_with_its_lease(hub: Hub) -> None:
    bus = lcm.LCM(hub.url)
    with served(hub.url, **AMPLE) as (rig, service):
        rig.during(asked, hub.url, "get", ["dps.gain"])
        request = json.dumps({"id": "me", "watch": ["dps.gain"], "lease": 0.2}).encode()

        def begun() -> bool:
            bus.publish("VTB_WATCH", request)  # again, if its lease has ended before it is looked at
            return service.watches == 1

        rig.until(begun)
        rig.until(lambda: service.watches == 0)
        # A client that renews its lease goes on, even if a renewal came too late.
        with LiveWatch(hub.url, ["dps.ticks"], lease=0.3, timeout=PATIENCE) as live:
            rig.during(live.wait, 1, timeout=PATIENCE)
            end = time.monotonic() + 1.0
            rig.until(lambda: time.monotonic() > end)
            rig.during(live.wait, len(live.arrays()["time"]) + 5, timeout=PATIENCE)
        rig.until(lambda: service.watches == 0)


def test_watching_does_not_change_actuation(hub: Hub) -> None:
    addresses = ["real.act.velocity", "dps.seen"]
    with served(hub.url, **AMPLE) as (rig, _), LiveWatch(hub.url, addresses, timeout=PATIENCE) as live:
        rig.during(live.wait, 100, timeout=PATIENCE)
    alone = Rig()
    while len(alone.bridge.sent) < len(rig.bridge.sent):
        alone.runtime.cycle()
        alone.runtime.clock.wait_until(alone.runtime.clock.now() + PERIOD)
    assert np.array_equal(alone.sent, rig.sent)
    assert np.ptp(rig.sent) > 0.1


def test_newest_values_are_kept(hub: Hub) -> None:
    with (
        served(hub.url, **AMPLE) as (rig, _),
        LiveWatch(hub.url, ["dps.ticks", "dps.velocity"], size=20, timeout=PATIENCE) as live,
    ):
        rig.during(live.wait, 50, timeout=PATIENCE)
        arrays = live.arrays()
    assert arrays["dps.velocity"].shape == (20, 2)
    assert np.array_equal(arrays["dps.ticks"], np.round(arrays["time"] / PERIOD))
    assert np.array_equal(arrays["time"], arrays["since"])


def test_watch_ends_with_the_loop(hub: Hub) -> None:
    with served(hub.url, **AMPLE) as (rig, _):
        live = LiveWatch(hub.url, ["dps.ticks"], timeout=PATIENCE)
        rig.during(live.wait, 5, timeout=PATIENCE)
    live.close()
    assert live.arrays()["dps.ticks"].size >= 5


def test_killed_worker_process_is_harmless(hub: Hub) -> None:
    with served(hub.url, **AMPLE) as (rig, service):
        with LiveWatch(hub.url, ["dps.ticks"], timeout=PATIENCE) as live:
            rig.during(live.wait, 5, timeout=PATIENCE)
            os.kill(service.pid, signal.SIGKILL)
            rig.until(lambda: service.watches == 0)
        before = len(rig.bridge.sent)
        rig.until(lambda: len(rig.bridge.sent) > before + 10)
    assert rig.runtime.guards.latched == ()
