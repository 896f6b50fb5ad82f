"""Changes as events of a log, and the generated LCM types."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vtbdrake.control.stepping import Change
from vtbdrake.recording import lcm_types
from vtbdrake.recording.lcm_types.lcmt_vtb_change import lcmt_vtb_change
from vtbdrake.recording.log_format import decode_changes, encode_changes

IMAGE = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"u.target": np.array([0.1, 1.0 / 3.0]), "dps.gain": 5e-324},
        {"sense.position": "real", "act.größe": "twin"},
        {"dps.perception": {"tick": 7, "image": IMAGE, "empty": np.zeros((0, 3)), "good": np.array(True)}},
        {"dps.perception": {"tick": 7}},
        {"a": np.array([[1, 2], [3, 4]], dtype=">i2"), "b": float("nan"), "c": -0.0},
    ],
)
def test_change_values_survive_round_trip(values: dict[str, Any]) -> None:
    messages = encode_changes([Change("first", {"x": 1.0}), Change("kind", values), Change("last", {})], 42, 1)
    sent = [lcmt_vtb_change.decode(message.encode()) for message in messages]
    (_, first), (number, change), (_, last) = decode_changes(sent)
    assert (first.kind, change.kind, last.kind, number) == ("first", "kind", "last", 42)
    _assert_equal(change.values, values)


def _assert_equal(found: Any, expected: Any) -> None:
    if isinstance(expected, dict):
        assert list(found) == list(expected)
        for key in expected:
            _assert_equal(found[key], expected[key])
    elif isinstance(expected, str):
        assert found == expected
    else:
        a, b = np.asarray(found), np.asarray(expected)
        assert a.shape == b.shape and a.dtype.kind == b.dtype.kind and a.dtype.itemsize == b.dtype.itemsize
        assert a.astype(b.dtype).tobytes() == b.tobytes()


def test_changes_of_two_cycles_stay_apart() -> None:
    messages = [*encode_changes([Change("reset", {})], 1, 0), *encode_changes([Change("reset", {})], 2, 0)]
    assert decode_changes(messages) == [(1, Change("reset", {})), (2, Change("reset", {}))]


FOLDER = Path(lcm_types.__path__[0])


def test_lcm_types_are_generated_from_their_source(tmp_path: Path) -> None:
    lcm_gen = Path(sys.executable).with_name("lcm-gen")
    options = ["--python", "--python-no-init", "--ppath", tmp_path]
    subprocess.run([lcm_gen, *options, FOLDER / "vtb_log.lcm"], check=True, timeout=60)
    made = {path.name: path.read_text() for path in tmp_path.glob("*.py")}
    assert made == {path.name: path.read_text() for path in FOLDER.glob("lcmt_*.py")}
    assert len(made) == 7
