"""The order of messages: of a machine, and of several senders that command the same."""

from __future__ import annotations

import math

import pytest

from vtbdrake.control.message_order import LATEST_TIME, MAX_SENDERS, CommandOrder, MachineOrder, MessageOrder

WINDOW = 0.1


def take(order: MessageOrder, *messages: tuple[float, float] | tuple[float, float, str]) -> list[str]:
    """Return the problems of messages: the time of arrival, the sender's time, and its name."""
    problems = []
    for arrived, sent, *sender in messages:
        problems.append(order.problem(sent, arrived, *sender))
        if not problems[-1]:
            order.note(sent, arrived, *sender)
    return problems


@pytest.mark.parametrize("order", [MachineOrder, CommandOrder])
@pytest.mark.parametrize("sent", [-1e-6, -(2.0**63) * 1e-6, (2.0**63 - 1) * 1e-6, LATEST_TIME * (1 + 1e-15), math.inf])
@pytest.mark.parametrize("sender", ["", "planner"])
def test_impossible_time_is_rejected_at_any_time(order: type[MessageOrder], sent: float, sender: str) -> None:
    messages = [(10.0 + i, sent if i in (0, 2, 4, 5, 6) else 100.0 + i, sender) for i in range(9)]
    told = take(order(WINDOW), *messages)
    assert [i for i, problem in enumerate(told) if problem] == [0, 2, 4, 5, 6]
    assert set(told) == {"", "impossible time"}


def test_machine_is_not_believed_a_single_time_after_a_misfit() -> None:
    far = 1e9
    told = take(MachineOrder(WINDOW), (0.0, 50.0), (0.01, 49.0), (0.2, far), (0.3, 50.3), (0.31, far), (0.5, 50.5))
    assert told == ["", "out of order", "ahead of time", "", "ahead of time", ""]


@pytest.mark.parametrize("period", [0.04, 2.0, 100.0])
def test_simulation_may_be_faster_than_real_time(period: float) -> None:
    """Two messages are a period apart by its clock, and come a hundred times as fast."""
    messages = [(0.01 * period * k, 50.0 + period * k) for k in range(20)]
    assert set(take(MachineOrder(WINDOW, period), *messages)) == {""}
    told = take(MachineOrder(WINDOW, period), *messages, (0.2 * period, 50.0 + 21.0 * period + 1.6))
    assert told[-1] == "ahead of time"


def test_sender_that_waits_for_this_computer_may_be_ahead_by_anything() -> None:
    order = MachineOrder(WINDOW)
    messages = [(0.01, 50.0), (0.02, 80.0), (0.03, 79.0), (0.04, 9000.0)]
    assert take(order, *messages) == ["", "ahead of time", "ahead of time", "ahead of time"]
    order = MachineOrder(WINDOW)
    order.limit_lead(False)
    assert take(order, *messages) == ["", "", "out of order", ""]
    order.limit_lead(True)
    assert take(order, (0.05, 9000.1), (0.06, 9002.0)) == ["", "ahead of time"]


@pytest.mark.parametrize("jump", [-20.0, 20.0, 1e6])
@pytest.mark.parametrize("period", [0.01, 1.0])
def test_machine_is_believed_a_new_time_that_goes_on(jump: float, period: float) -> None:
    order = MachineOrder(WINDOW)
    take(order, *[(k * period, 100.0 + k * period) for k in range(20)])
    times = [k * period for k in range(20, 60)]
    exchanged = [(t, 100.0 + jump + times[i ^ 1]) for i, t in enumerate(times)]
    told = take(order, *exchanged)
    first = told.index("")
    assert first <= WINDOW / period + 4 and order.clock_jumps == 1
    assert set(told[first:]) == {"", "out of order"}


@pytest.mark.parametrize("ahead", [1.0, 1.4, 3600.0, -1.0, -3600.0])
@pytest.mark.parametrize("names", [("", ""), ("planner", "operator")])
def test_commands_of_two_clocks_are_all_new(ahead: float, names: tuple[str, str]) -> None:
    order = CommandOrder(WINDOW)
    messages = []
    for k in range(41):  # at 20 Hz, and a stop shortly after each
        t = 5000.0 + 0.05 * k
        messages += [(t, t + ahead, names[0]), (t + 0.001, t + 0.001, names[1])]
    assert take(order, *messages) == [""] * 82


def test_order_of_each_named_sender_is_kept() -> None:
    told = take(
        CommandOrder(WINDOW),
        *[(1.0, 5.0, "a"), (1.0, 3.0, "b"), (1.01, 4.9, "a"), (1.01, 3.1, "b"), (1.02, 5.0, "a"), (1.02, 5.1, "a")],
    )
    assert told == ["", "", "out of order", "", "duplicate", ""]


@pytest.mark.parametrize("jump", [-1.4, -1e4, 0.0, 1.4, 1e4])
def test_clock_of_a_named_sender_may_be_set(jump: float) -> None:
    order = CommandOrder(WINDOW)
    assert take(order, (1.0, 2e4, "a"), (1.5, 2e4 + jump, "a")) == ["", ""]
    assert order.clock_jumps == (jump < 0.0)


def test_time_of_zero_tells_nothing() -> None:
    assert take(CommandOrder(WINDOW), (1.0, 0.0, "a"), (1.0, 0.0, "a"), (1.01, 7.0, "a"), (1.02, 0.0, "a")) == [""] * 4


def test_senders_are_forgotten_in_turn() -> None:
    order = CommandOrder(WINDOW)
    take(order, (1.0, 9.0, "first"), *[(1.0, 5.0, str(k)) for k in range(MAX_SENDERS - 1)])
    assert take(order, (1.0, 8.0, "first"), (1.0, 1.0, "new"), (1.0, 4.0, "0"), (1.0, 8.0, "first")) == [
        "out of order",
        "",
        "",  # forgotten
        "out of order",
    ]
