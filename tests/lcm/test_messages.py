"""The compiled decoder and encoder of messages agree with `struct` and with lcm-gen."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from vtbdrake.lcm.maps import Field
from vtbdrake.lcm.messages import MalformedError, MessageDecoder, MessageEncoder

EVERY = "dqfihb?"
HEAD = b"\xf1\xf2\xf3\xf4\xf5\xf6\xf7\xf8"
INTEGERS = {"q": 64, "i": 32, "h": 16, "b": 8}
TYPES = {"d": "double", "q": "int64_t", "f": "float", "i": "int32_t", "h": "int16_t", "b": "int8_t", "?": "boolean"}


def fields(code: str, *shape: int | str) -> list[Field]:
    """Return the fields of a message with a time and an array."""
    return [Field("utime", "int64_t"), Field("numbers", TYPES[code], shape)]


def message(code: str, numbers: list[float], utime: int = 5) -> bytes:
    return HEAD + struct.pack(f">q{len(numbers)}{code}", utime, *numbers)


def reason(decoder: MessageDecoder, data: bytes) -> str:
    with pytest.raises(MalformedError) as caught:
        decoder.decode(data)
    return caught.value.reason


@pytest.mark.parametrize("code", EVERY)
@settings(max_examples=50)
@given(data=st.data())
def test_numbers_are_decoded_as_struct_reads_them(code: str, data: st.DataObject) -> None:
    size = 3 * struct.calcsize(f">{code}")
    raw = data.draw(st.binary(min_size=size, max_size=size))
    decoder = MessageDecoder(HEAD, fields(code, 3), {"a": ["numbers"]}, "utime")
    sent, values = decoder.decode(HEAD + struct.pack(">q", 1_500_000) + raw)
    assert sent == 1_500_000 * 1e-6
    np.testing.assert_array_equal(values["a"], np.array(struct.unpack(f">3{code}", raw), dtype=float))


@settings(max_examples=300)
@given(n=st.integers(0, 3), m=st.integers(0, 3), text=st.binary(max_size=5), cut=st.integers(0, 200))
def test_fields_behind_variable_ones_are_found(n: int, m: int, text: bytes, cut: int) -> None:
    layout = [
        Field("n", "int16_t"),
        Field("m", "int8_t"),
        Field("text", "string"),
        Field("pairs", "", ("n",), (Field("pairs.name", "string", (2,)), Field("pairs.x", "int8_t"))),
        Field("grid", "float", ("n", "m", 2)),
        Field("z", "int32_t", ("m",)),
    ]
    grid, z = [0.5 * k for k in range(n * m * 2)], [k - 7 for k in range(m)]
    string = struct.pack(f">I{len(text)}s", len(text), text)
    pairs = n * (2 * string + b"\7")
    data = HEAD + struct.pack(">hb", n, m) + string + pairs + struct.pack(f">{len(grid)}f{m}i", *grid, *z)
    decoder = MessageDecoder(HEAD, layout, {"z": ["z"], "n": ["n"], "grid": ["grid"]})
    sent, values = decoder.decode(data)
    assert math.isnan(sent)
    assert {name: value.tolist() for name, value in values.items()} == {"z": z, "n": [n], "grid": grid}
    if cut < len(data):
        assert reason(decoder, data[:cut]) == "truncated"
    assert reason(decoder, data + b"x") == "trailing"
    assert reason(decoder, b"\0" + data[1:]) == "fingerprint"


@pytest.mark.parametrize("code", INTEGERS)
def test_impossible_lengths_are_rejected_without_reading(code: str) -> None:
    layout = [Field("n", TYPES[code]), Field("grid", "double", ("n", "n", "n", "n"))]
    decoder = MessageDecoder(HEAD, layout, {"grid": ["grid"]})
    for length, expected in ((-1, "size"), (-(2 ** (INTEGERS[code] - 1)), "size"), (100, "truncated")):
        assert reason(decoder, HEAD + struct.pack(f">{code}", length) + bytes(16)) == expected
    assert reason(decoder, HEAD + struct.pack(f">{code}", 2 ** (INTEGERS[code] - 1) - 1) + bytes(16)) == "truncated"


@settings(max_examples=500)
@given(st.binary(max_size=60) | st.lists(st.sampled_from([0, 0, 0, 1, 2, 255]), max_size=60).map(bytes))
def test_any_bytes_are_decoded_or_rejected(data: bytes) -> None:
    layout = [
        Field("n", "int8_t"),
        Field("text", "string"),
        Field("pairs", "", ("n",), (Field("pairs.n", "int8_t"), Field("pairs.x", "float", ("pairs.n",)))),
        Field("z", "int16_t", ("n", 2)),
        Field("d", "double", ("n",)),
    ]
    decoder = MessageDecoder(HEAD, layout, {"z": ["z"], "d": ["d"]})
    try:
        _, values = decoder.decode(HEAD + data)
    except MalformedError as error:
        assert error.reason in ("truncated", "trailing", "size")
    else:
        assert len(values["z"]) == 2 * len(values["d"]) == 2 * data[0]


def test_decoded_values_are_independent_copies() -> None:
    decoder = MessageDecoder(HEAD, fields("d", 2), {"a": ["numbers"]}, "utime")
    before = decoder.decode(message("d", [1.0, 2.0]))[1]["a"]
    decoder.decode(message("d", [3.0, 4.0]))
    np.testing.assert_array_equal(before, [1.0, 2.0])


@pytest.mark.parametrize(
    ("layout", "signals", "stamp"),
    [
        (fields("d", "later"), {}, ""),
        (fields("d", "numbers"), {}, ""),
        ([Field("x", "double"), Field("numbers", "double", ("x",))], {}, ""),
        ([Field("x", "int32_t", (2,)), Field("numbers", "double", ("x",))], {}, ""),
        ([Field("m", "", (), (Field("m.n", "int32_t"),)), Field("numbers", "double", ("m.n",))], {}, ""),
        ([Field("m", "", (1,), (Field("m.x", "double"),))], {"a": ["m.x"]}, ""),
        ([Field("m", "", (1,), (Field("m.x", "int64_t"),))], {}, "m.x"),
        ([Field("m", "", (), (Field("m.x", "double"),))], {"a": ["m"]}, ""),
        (fields("d", 2), {"a": ["other"]}, ""),
        (fields("d", 2), {}, "numbers"),
        ([Field("numbers", "string")], {"a": ["numbers"]}, ""),
    ],
)
def test_inconsistent_layout_is_refused(layout: Any, signals: Any, stamp: str) -> None:
    with pytest.raises((ValueError, KeyError)):
        MessageDecoder(HEAD, layout, signals, stamp)


def test_only_bytes_are_decoded() -> None:
    nothing: Any = None
    with pytest.raises(TypeError):
        MessageDecoder(HEAD, fields("d", 2), {}).decode(nothing)


@pytest.mark.parametrize("code", EVERY)
@settings(max_examples=100)
@given(entries=st.lists(st.floats(-1e40, 1e40) | st.floats(-200.0, 200.0) | st.floats(), min_size=2, max_size=2))
# The ends of the integers' ranges, and what lies next to them.
@example(entries=[-(2.0**63), 2.0**63 - 1024.0])
@example(entries=[0.0, 2.0**63])
@example(entries=[1.5 * 2.0**63, 0.0])
@example(entries=[0.0, -(2.0**63) - 2048.0])
@example(entries=[-(2.0**31), 2.0**31 - 1.0])
@example(entries=[2.0**31, 0.0])
@example(entries=[0.0, -(2.0**31) - 1.0])
@example(entries=[-(2.0**15), 2.0**15 - 1.0])
@example(entries=[2.0**15, 0.0])
@example(entries=[0.0, -(2.0**15) - 1.0])
@example(entries=[-(2.0**7), 2.0**7 - 1.0])
@example(entries=[2.0**7, 0.0])
@example(entries=[0.0, -(2.0**7) - 1.0])
def test_numbers_are_encoded_as_struct_writes_them(code: str, entries: list[float]) -> None:
    layout = [Field("utime", "int64_t"), Field("b", TYPES[code]), Field("a", TYPES[code])]
    encoder = MessageEncoder(HEAD, layout, {"a": ["a", "b"]}, "utime", example=message(code, [0, 0]))
    utime = 2**60 + 1
    try:
        numbers = entries[::-1] if code in "df" else [round(entry) for entry in entries[::-1]]
        expected = message(code, numbers, utime)
    except (struct.error, OverflowError, ValueError):
        with pytest.raises(OverflowError, match="does not fit into its field"):
            encoder.encode({"a": np.array(entries)}, utime)
        return
    if code == "f" and not np.isfinite(entries).all():
        return
    assert encoder.encode({"a": np.array(entries)}, utime) == expected


@pytest.mark.parametrize(
    "value",
    [[1.0, 2.0], (1, 2), np.array([1.0, 2.0], np.float32), np.array([1, 2]), np.array([1.0, 0.0, 2.0, 0.0])[::2]],
)
def test_other_vectors_are_encoded_by_value(value: Any) -> None:
    encoder = MessageEncoder(HEAD, fields("d", 2), {"a": ["numbers"]}, example=message("d", [0.0, 0.0]))
    assert encoder.encode({"a": value}, 0) == message("d", [1.0, 2.0], 5)


@pytest.mark.parametrize("value", [[1.0], np.ones(3), np.ones((2, 1)), 1.0, None, "text"])
def test_vectors_of_another_size_are_not_encoded(value: Any) -> None:
    encoder = MessageEncoder(HEAD, fields("d", 2), {"a": ["numbers"]}, example=message("d", [0.0, 0.0]))
    with pytest.raises((ValueError, TypeError)):
        encoder.encode({"a": value}, 0)


def test_time_that_does_not_fit_is_not_encoded() -> None:
    encoder = MessageEncoder(HEAD, [Field("utime", "int32_t")], {}, "utime", example=HEAD + bytes(4))
    with pytest.raises(OverflowError, match="the time 2147483648 us does not fit"):
        encoder.encode({}, 2**31)


def test_example_of_another_layout_is_refused() -> None:
    with pytest.raises(MalformedError, match="truncated"):
        MessageEncoder(HEAD, fields("d", 2), {}, example=message("d", [0.0]))
    nothing: Any = None
    with pytest.raises(TypeError):
        MessageEncoder(HEAD, fields("d", 2), {}, example=nothing)


class Made(dict[str, np.ndarray]):
    """A mapping that makes every vector on request."""

    def __getitem__(self, name: str) -> Any:
        return np.full(2, float(name))


def test_encoder_keeps_temporary_vectors_alive() -> None:
    layout = [Field("a", "double", (2,)), Field("b", "double", (2,))]
    encoder = MessageEncoder(HEAD, layout, {"1": ["a"], "2": ["b"]}, example=HEAD + bytes(32))
    assert encoder.encode(Made(), 0) == HEAD + struct.pack(">4d", 1.0, 1.0, 2.0, 2.0)
