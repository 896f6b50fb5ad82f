"""Schunk WSG: messages have the conventions of its driver, as Drake's systems read and send them."""

from __future__ import annotations

from typing import Any

import pytest
from drake import lcmt_schunk_wsg_command
from pydrake.manipulation import SchunkWsgCommandReceiver

from tests.lcm.messages_of_drivers import decode, encode, read_by_drake
from vtbdrake.lcm.wsg_messages import wsg_command, wsg_status


def test_gripper_is_in_metres() -> None:
    fields = {"opening": "actual_position_mm", "speed": "actual_speed_mm_per_s", "force": "actual_force"}
    map = wsg_status(fields)
    data = encode(map, {"opening": [0.05], "speed": [-0.25], "force": [12.0]})
    assert decode(map, data, size=1) == {"opening": [0.05], "speed": [-0.25], "force": [12.0]}


@pytest.mark.parametrize("force", [40.0, None])
def test_gripper_commands_are_read_by_drake(force: float | None) -> None:
    values = {"opening": [0.05]} if force else {"opening": [0.05], "force": [40.0]}
    map = wsg_command({"opening": "target_position_mm"} | ({} if force else {"force": "force"}), force=force)
    receiver = SchunkWsgCommandReceiver(0.02, 10.0)
    read = read_by_drake(receiver, lcmt_schunk_wsg_command, encode(map, values), "position", "force_limit")
    assert read == [[0.05], [40.0]]


@pytest.mark.parametrize("arguments", [{}, {"fields": ["force"], "force": 1.0}])
def test_map_that_does_not_fit_is_refused(arguments: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="with one largest force"):
        wsg_command(**arguments)
