"""Robots of others: the list of models, and one of them from the file to the driven machine."""

from collections import Counter
from pathlib import Path

import pytest

from tests.project.foreign_robots import CACHE, GYMNASIUM, OF_THE_ROBOT, ROBOTS, Outcome, fetch, table, try_robot

pytestmark = pytest.mark.one_python

SMALL = "reacher.xml"


def test_sixty_models_and_more_are_listed_once() -> None:
    assert len(ROBOTS) >= 60
    assert max(Counter(map(str, ROBOTS)).values()) == 1
    assert all(robot.name.isidentifier() for robot in ROBOTS)


def test_table_counts_by_source() -> None:
    outcomes = [
        Outcome("gymnasium:a.xml", written=True, tests=True, driven=True),
        Outcome("gymnasium:b.xml", written=True, driven=True),
        Outcome("drake:c.sdf", refused="a sentence"),
    ]
    rows = list(table(outcomes))[2:]
    assert rows == ["| gymnasium | 2 | 2 | 1 | 2 |", "| drake | 1 | 0 | 0 | 0 |", "| all | 3 | 2 | 1 | 2 |"]


@pytest.mark.slow
def test_a_foreign_robot_drives_its_machine(tmp_path: Path) -> None:
    try:
        fetch(CACHE, [GYMNASIUM])
    except ConnectionError as error:
        pytest.skip(str(error))
    robot = next(robot for robot in ROBOTS if (robot.source, robot.path) == (GYMNASIUM, SMALL))
    outcome = try_robot(robot, CACHE, tmp_path, tests=OF_THE_ROBOT)
    assert outcome.written and outcome.tests and outcome.driven, outcome
