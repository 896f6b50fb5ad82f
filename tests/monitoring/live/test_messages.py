"""Valid and invalid requests."""

import json

import pytest

from vtbdrake.monitoring.live.messages import (
    GET,
    SET,
    STATUS,
    WATCH,
    ReadRequest,
    RequestError,
    SetRequest,
    StatusRequest,
    parse_request,
    request_id,
)

pytestmark = pytest.mark.one_python


def encoded(**message):
    return json.dumps(message).encode()


def test_valid_requests_are_parsed():
    assert parse_request(SET, encoded(id="a", set={"x": 1, "y": [1.5, [2]]})) == SetRequest(
        "a", {"x": 1, "y": [1.5, [2]]}
    )
    assert parse_request(GET, encoded(id="a", get=["x", "y", "x"])) == ReadRequest("a", ("x", "y"))
    assert parse_request(WATCH, encoded(id="a", watch=["x"], every=3, lease=0.5)) == ReadRequest("a", ("x",), 3, 0.5)
    assert parse_request(STATUS, encoded(id="a", status=True)) == StatusRequest("a")
    assert parse_request(WATCH, encoded(id="a", watch=[])) == ReadRequest("a", (), 1, 2.0)


@pytest.mark.parametrize(
    ("channel", "data", "reason"),
    [
        (SET, b"{", "must be JSON"),
        (SET, b"\xff\xfe", "must be JSON"),
        (SET, b"[" * 10_000, "must be JSON"),
        (SET, b"[1]", "must be a JSON object, not"),
        (SET, b" " * 70_000, "at most 65536 bytes, not 70000"),
        (SET, b'{"id": "a", "set": {"x": NaN}}', "the value of x must be a finite number or a list of them, not nan"),
        (SET, b'{"id": "a", "set": {"x": 1e999}}', "the value of x must be a finite number"),
        (
            SET,
            b'{"id": "a", "set": {"x[3]": 1' + b"0" * 400 + b"}}",
            "the value of x[3] must lie within +-1.8e+308, the largest",
        ),
        (SET, encoded(id="a", set={"x": "1"}), "the value of x must be a number or a list of numbers"),
        (SET, encoded(id="a", set={"x": [True]}), "the value of x must be a number"),
        (SET, encoded(id="a", set={}), "1 to 64 values, not "),
        (SET, encoded(id="a", set={str(k): 0 for k in range(65)}), "1 to 64 values, not "),
        (SET, encoded(id="a", get=["x"]), "this request must have id, set, not 'id, get'"),
        (SET, encoded(id=7, set={"x": 1}), "the id must be"),
        (SET, encoded(id="a/b", set={"x": 1}), "the id must be"),
        (STATUS, encoded(id="a", status=1), "status must be true, not 1"),
        (GET, encoded(id="a", get="x"), "a list of strings"),
        (GET, encoded(id="a", get=[]), "1 to 64 addresses, not 0"),
        (WATCH, encoded(id="a", watch=["x"] * 65), "0 to 64 addresses, not 65"),
        (WATCH, encoded(id="a", watch=["x"], every=0), "at least 1, not 0"),
        (WATCH, encoded(id="a", watch=["x"], every=1.5), "at least 1, not 1.5"),
        (WATCH, encoded(id="a", watch=["x"], lease=1e9), "not 1000000000.0"),
    ],
)
def test_invalid_requests_are_rejected(channel, data, reason):
    with pytest.raises(RequestError) as error:
        parse_request(channel, data)
    assert reason in str(error.value)


def test_request_id_is_found():
    assert request_id(encoded(id="a", nonsense=1)) == "a"
    assert [request_id(data) for data in (b"{", b"[]", encoded(id=["a"]), b" " * 70_000)] == [""] * 4
