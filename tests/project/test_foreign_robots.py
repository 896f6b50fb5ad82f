"""Robots of others: the list of models, and one of them from the file to the driven machine."""

import json
from collections import Counter
from dataclasses import asdict
from pathlib import Path

import pytest

from tests.project.foreign_robots import (
    CACHE,
    GYMNASIUM,
    OF_THE_ROBOT,
    ROBOTS,
    Outcome,
    fetch,
    read_outcomes,
    table,
    try_robot,
)

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
    assert rows == ["| gymnasium | 2 | 2 | 1 | 2 | 0 |", "| drake | 1 | 0 | 0 | 0 | 1 |", "| all | 3 | 2 | 1 | 2 | 1 |"]


def test_those_that_fail_are_tried_again(tmp_path: Path) -> None:
    good, failed, refused = Outcome("a", written=True), Outcome("b", failures="it falls"), Outcome("c", refused="no")
    file = tmp_path / "robots.json"
    file.write_text("".join(json.dumps(asdict(outcome)) + "\n" for outcome in (failed, good, refused)))
    assert read_outcomes(file) == [failed, good, refused]
    assert read_outcomes(file, again=True) == read_outcomes(file) == [good]


@pytest.mark.slow
def test_a_foreign_robot_drives_its_machine(tmp_path: Path) -> None:
    try:
        fetch(CACHE, [GYMNASIUM])
    except ConnectionError as error:
        pytest.skip(str(error))
    robot = next(robot for robot in ROBOTS if (robot.source, robot.path) == (GYMNASIUM, SMALL))
    outcome = try_robot(robot, CACHE, tmp_path, tests=OF_THE_ROBOT)
    assert outcome.written and outcome.tests and outcome.driven, outcome
