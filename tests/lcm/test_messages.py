"""The compiled decoder and encoder of messages agree with `struct`."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.control.test_kernels import NOT_VECTORS
from vtbdrake.control.kernels import Box, ReceivedSignal
from vtbdrake.lcm.messages import MessageDecoder, MessageEncoder

EVERY = "dqfihb?"
HEAD = b"\xf1\xf2\xf3\xf4\xf5\xf6\xf7\xf8"
UTIME, NUMBERS = 8, 16  # offsets: of the time, and of what follows it


def message(code: str, numbers: list[float], utime: int = 5) -> bytes:
    return HEAD + struct.pack(f">q{len(numbers)}{code}", utime, *numbers)


def intake(
    code: str, count: int, *, limit: float = math.inf, stamp: bool = True
) -> tuple[MessageDecoder, list[ReceivedSignal]]:
    """Of two signals: the first has one entry, the second the others."""
    receptions, example = [ReceivedSignal(), ReceivedSignal()], message(code, [0] * count)
    sizes = [1, count - 1]
    width = struct.calcsize(f">{code}")
    return (
        MessageDecoder(
            example,
            fixed=[(0, 8)],
            places=[(0, 0, NUMBERS, 1, code), (1, 0, NUMBERS + width, count - 1, code)],
            stamp=(UTIME, 1, "q") if stamp else None,
            receptions=receptions,
            sizes=sizes,
            lower=[-limit] * count,
            upper=[limit] * count,
        ),
        receptions,
    )


@pytest.mark.parametrize("value", NOT_VECTORS)
def test_only_plain_arrays_of_doubles_are_written(value: Any) -> None:
    form = MessageEncoder(
        message("d", [0.0, 0.0]), places=[(0, 0, NUMBERS, 2, "d")], stamp=None, names=["a"], sizes=[2]
    )
    assert form.fill({"a": value}, 0) is None


@pytest.mark.parametrize("code", EVERY)
@settings(max_examples=50)
@given(data=st.data())
def test_numbers_are_taken_in_as_struct_reads_them(code: str, data: st.DataObject) -> None:
    raw = data.draw(st.binary(min_size=3 * struct.calcsize(f">{code}"), max_size=3 * struct.calcsize(f">{code}")))
    expected = np.array(struct.unpack(f">3{code}", raw), dtype=float)
    take, (first, others) = intake(code, 3)
    sent = take.take(HEAD + struct.pack(">q", 1_500_000) + raw, 1.0, math.inf, 7.0)
    if not (np.abs(expected) <= np.inf).all():  # a NaN
        assert sent is None and first.count == 0
        return
    assert sent == first.sent == others.sent == 1_500_000 * 1e-6
    assert first.arrived == 7.0 and (first.count, others.count) == (1, 1)
    np.testing.assert_array_equal(np.concatenate([first.value, others.value]), expected)


@pytest.mark.parametrize(
    ("data", "last"),
    [
        (message("d", [1.0, 2.0, 3.0])[:-1], 0.0),
        (message("d", [1.0, 2.0, 3.0, 4.0]), 0.0),
        (b"\0" + message("d", [1.0, 2.0, 3.0])[1:], 0.0),
        (message("d", [1.0, 2.0, 9.0]), 0.0),
        (message("d", [1.0, math.nan, 3.0]), 0.0),
        (message("d", [1.0, 2.0, 3.0]), 5e-6),
        (b"", 0.0),
    ],
    ids=["short", "long", "fingerprint", "limits", "NaN", "not newer", "empty"],
)
def test_of_other_messages_nothing_is_taken_in(data: bytes, last: float) -> None:
    take, receptions = intake("d", 3, limit=8.0)
    assert take.take(data, last, math.inf, 1.0) is None
    assert [(reception.count, reception.value) for reception in receptions] == [(0, None)] * 2


def test_values_of_earlier_messages_stay_as_they_are() -> None:
    take, (_, others) = intake("d", 3)
    take.take(message("d", [1.0, 2.0, 3.0], 1), 0.0, math.inf, 1.0)
    before = others.value
    take.take(message("d", [4.0, 5.0, 6.0], 2), 0.0, math.inf, 1.0)
    np.testing.assert_array_equal(before, [2.0, 3.0])
    np.testing.assert_array_equal(others.value, [5.0, 6.0])


def test_without_a_time_all_messages_are_new() -> None:
    take, (first, _) = intake("d", 3, stamp=False)
    assert math.isnan(take.take(message("d", [1.0, 2.0, 3.0]), math.inf, math.inf, 1.0) or 0.0)
    assert math.isnan(first.sent) and first.count == 1


def test_places_outside_of_the_message_are_refused() -> None:
    with pytest.raises(ValueError, match="not in a message of 24 bytes"):
        MessageEncoder(message("d", [0.0]), places=[(0, 0, NUMBERS + 1, 1, "d")], stamp=None, names=["a"], sizes=[1])
    with pytest.raises(ValueError, match="a has no entries 0 to 1"):
        MessageEncoder(message("d", [0.0, 0.0]), places=[(0, 0, NUMBERS, 2, "d")], stamp=None, names=["a"], sizes=[1])
    with pytest.raises(ValueError, match="other numbers than the signals"):
        MessageDecoder(
            message("d", [0.0]),
            fixed=[],
            places=[(0, 0, NUMBERS, 1, "d")],
            stamp=None,
            receptions=[ReceivedSignal()],
            sizes=[2],
            lower=[0.0, 0.0],
            upper=[0.0, 0.0],
        )


@pytest.mark.parametrize(
    "place", [(0, -1, "d"), (8, 1, "d"), (-1, 1, "b"), (0, 2**61, "d"), (2**63, 1, "b"), (0, 2**64, "b"), (9, 0, "d")]
)
def test_no_place_reaches_out_of_the_message(place: tuple[int, int, str]) -> None:
    offset, count, code = place
    signals: dict[str, Any] = {"receptions": [ReceivedSignal()], "sizes": [count], "lower": [], "upper": []}
    with pytest.raises(ValueError, match=r"other numbers than|not in a message of 8 bytes"):
        MessageDecoder(bytes(8), fixed=[], places=[(0, 0, *place)], stamp=None, **signals)
    with pytest.raises(ValueError, match="not in a message of 8 bytes"):
        MessageEncoder(bytes(8), places=[(0, 0, *place)], stamp=None, names=["a"], sizes=[1])
    with pytest.raises(ValueError, match="not in a message of 8 bytes"):
        MessageDecoder(
            bytes(8), fixed=[(offset, count * 8)], places=[], stamp=None, receptions=[], sizes=[], lower=[], upper=[]
        )


def test_a_time_is_one_number_of_the_message() -> None:
    with pytest.raises(ValueError, match="1 numbers from byte 8 on are not in a message of 8 bytes"):
        MessageEncoder(bytes(8), places=[], stamp=(8, 0, "q"), names=[], sizes=[])


def test_an_intake_has_a_reception_and_a_size_for_every_signal() -> None:
    example, places = message("d", [0.0]), [(0, 0, NUMBERS, 1, "d")]
    for receptions, sizes in (([ReceivedSignal()] * 2, [1]), ([ReceivedSignal()] * 2, [3, -2])):
        with pytest.raises(ValueError, match="other numbers than the signals"):
            MessageDecoder(
                example,
                fixed=[],
                places=places,
                stamp=None,
                receptions=receptions,
                sizes=sizes,
                lower=[0.0],
                upper=[0.0],
            )
    with pytest.raises(TypeError, match="ReceivedSignal"):
        other: Any = [object()]
        MessageDecoder(
            example, fixed=[], places=places, stamp=None, receptions=other, sizes=[1], lower=[0.0], upper=[0.0]
        )


@pytest.mark.parametrize(
    ("places", "sizes", "boxes"),
    [
        ([(-1, 0, NUMBERS, 1, "d")], [1], None),
        ([(1, 0, NUMBERS, 1, "d")], [1], None),
        ([], [], None),
        ([], [1], []),
    ],
)
def test_a_form_knows_the_vectors_of_all_its_places(places: Any, sizes: list[int], boxes: Any) -> None:
    with pytest.raises(ValueError, match="vector"):
        MessageEncoder(message("d", [0.0]), places=places, stamp=None, names=["a"], sizes=sizes, boxes=boxes)


def test_what_is_no_message_is_refused() -> None:
    nothing: Any = None
    with pytest.raises(TypeError, match="expected bytes"):
        intake("d", 3)[0].take(nothing, 0.0, math.inf, 1.0)


class Made(dict[str, np.ndarray]):
    """Makes every vector when it is asked for."""

    def get(self, name: str, default: Any = None) -> Any:
        return np.full(2, float(name))


def test_a_form_takes_vectors_that_nobody_else_keeps() -> None:
    places = [(0, 0, NUMBERS, 2, "d"), (1, 0, NUMBERS + 16, 2, "d")]
    form = MessageEncoder(message("d", [0.0] * 4), places=places, stamp=None, names=["1", "2"], sizes=[2, 2])
    assert form.fill(Made(), 0) == message("d", [1.0, 1.0, 2.0, 2.0])


@pytest.mark.parametrize("code", EVERY)
@settings(max_examples=100)
@given(entries=st.lists(st.floats(-1e40, 1e40) | st.floats(-200.0, 200.0) | st.floats(), min_size=2, max_size=2))
def test_a_form_is_filled_in_as_struct_writes(code: str, entries: list[float]) -> None:
    form = MessageEncoder(
        message(code, [0, 0]),
        places=[(0, 1, NUMBERS, 1, code), (0, 0, NUMBERS + struct.calcsize(f">{code}"), 1, code)],
        stamp=(UTIME, 1, "q"),
        names=["a"],
        sizes=[2],
    )
    utime = 2**60 + 1
    written = form.fill({"a": np.array(entries)}, utime)
    try:
        numbers = entries[::-1] if code in "df" else [round(entry) for entry in entries[::-1]]
        expected = message(code, numbers, utime)
    except (struct.error, OverflowError, ValueError):
        assert written is None
        return
    if written is None:  # what is not finite, or close to the ends of an integer, is left to the slow way
        assert not all(abs(entry) < 9.1e18 for entry in entries)
    else:
        assert written == expected


@pytest.mark.parametrize("values", [{}, {"b": np.ones(1)}, {"a": np.full(1, 1.5)}, {"a": np.full(1, math.nan)}])
def test_a_form_takes_all_its_vectors_within_their_limits(values: dict[str, np.ndarray]) -> None:
    example, places, box = message("d", [0.0]), [(0, 0, NUMBERS, 1, "d")], Box([-1.0], [1.0])
    form = MessageEncoder(example, places=places, stamp=None, names=["a"], sizes=[1], boxes=[box])
    assert form.fill(values, 0) is None
    assert form.fill({**values, "a": np.ones(1)}, 0) == message("d", [1.0])
