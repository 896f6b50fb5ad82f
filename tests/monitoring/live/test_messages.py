"""What is a request, and why the others are not."""

import json

import pytest

from vtbdrake.monitoring.live.messages import (
    GET,
    SET,
    WATCH,
    ReadRequest,
    RequestError,
    SetRequest,
    nested,
    parse,
    parse_id,
)


def encoded(**message):
    return json.dumps(message).encode()


def test_requests_are_what_they_say():
    assert parse(SET, encoded(id="a", set={"x": 1, "y": [1.5, [2]]})) == SetRequest("a", {"x": 1, "y": [1.5, [2]]})
    assert parse(GET, encoded(id="a", get=["x", "y", "x"])) == ReadRequest("a", ("x", "y"))
    assert parse(WATCH, encoded(id="a", watch=["x"], every=3, lease=0.5)) == ReadRequest("a", ("x",), 3, 0.5)
    assert parse(WATCH, encoded(id="a", watch=[])) == ReadRequest("a", (), 1, 2.0)


@pytest.mark.parametrize(
    ("channel", "data", "reason"),
    [
        (SET, b"{", "JSON, which this is not"),
        (SET, b"\xff\xfe", "JSON, which this is not"),
        (SET, b"[" * 10_000, "JSON, which this is not"),
        (SET, b"[1]", "a JSON object, not"),
        (SET, b" " * 70_000, "at most 65536 bytes, not 70000"),
        (SET, b'{"id": "a", "set": {"x": NaN}}', "the value of x is a finite number or a list of such, not nan"),
        (SET, b'{"id": "a", "set": {"x": 1e999}}', "the value of x is a finite number"),
        (SET, encoded(id="a", set={"x": "1"}), "the value of x is a finite number"),
        (SET, encoded(id="a", set={"x": [True]}), "the value of x is a finite number"),
        (SET, encoded(id="a", set={}), "1 to 64 values, not "),
        (SET, encoded(id="a", set={str(k): 0 for k in range(65)}), "1 to 64 values, not "),
        (SET, encoded(id="a", get=["x"]), "this request has id, set, not 'id, get'"),
        (SET, encoded(id=7, set={"x": 1}), "has an id"),
        (SET, encoded(id="a/b", set={"x": 1}), "has an id"),
        (GET, encoded(id="a", get="x"), "a list of texts"),
        (GET, encoded(id="a", get=[]), "1 to 64 addresses, not 0"),
        (WATCH, encoded(id="a", watch=["x"] * 65), "0 to 64 addresses, not 65"),
        (WATCH, encoded(id="a", watch=["x"], every=0), "1 or more, not 0"),
        (WATCH, encoded(id="a", watch=["x"], every=1.5), "1 or more, not 1.5"),
        (WATCH, encoded(id="a", watch=["x"], lease=1e9), "at 1000000000.0"),
    ],
)
def test_others_are_refused(channel, data, reason):
    with pytest.raises(RequestError) as error:
        parse(channel, data)
    assert reason in str(error.value)


def test_an_id_is_found_where_there_is_one():
    assert parse_id(encoded(id="a", nonsense=1)) == "a"
    assert [parse_id(data) for data in (b"{", b"[]", encoded(id=["a"]), b" " * 70_000)] == [""] * 4


def test_numbers_are_nested_as_their_shape_says():
    assert nested((1.0,), ()) == 1.0
    assert nested((1.0, 2.0), (2,)) == [1.0, 2.0]
    assert nested(tuple(range(6)), (3, 2)) == [[0, 1], [2, 3], [4, 5]]
    assert nested((), (0,)) == []
