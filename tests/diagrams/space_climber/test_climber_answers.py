"""Rows O4 and R1 of the table of answers can say no, for each of their parts."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan

import numpy as np
import pytest

from vtbdrake.optimization import Boundary
from vtbdrake.reasoning import Decision
from vtbdrake_diagrams.space_climber.studies.answers import HeadingAnswer, PayloadAnswer
from vtbdrake_diagrams.space_climber.studies.crater import Case, Climb

pytestmark = pytest.mark.one_python


def bounds(lower: float, upper: float) -> Boundary:
    return Boundary("mass", "kg", lower, upper, np.array([[lower, upper]]))


HEAVY = PayloadAnswer(
    {"moon": bounds(31.0, 33.0), "earth": bounds(40.0, 41.0), "moon, 10 deg downhill": bounds(30.0, 31.0)},
    {"half the step": bounds(32.0, 35.0)},
    bounds(95.0, 96.0),
    static=96.5,
    mujoco={"moon": (34.0, 36.0), "earth": (36.0, 40.0), "moon, 10 deg downhill": (31.0, 32.0)},
)


def test_boundaries_that_are_found_hold() -> None:
    assert HEAVY.holds
    assert replace(HEAVY, boundaries=HEAVY.boundaries | {"moon, a stride in 8 s": bounds(60.0, inf)}).holds


def test_the_interval_includes_settings_of_the_solver() -> None:
    assert HEAVY.interval("moon") == (31.0, 35.0)
    assert HEAVY.interval("earth") == (40.0, 41.0)


@pytest.mark.parametrize(
    "change",
    [
        {"boundaries": HEAVY.boundaries | {"moon": bounds(-inf, 33.0)}},
        {"boundaries": HEAVY.boundaries | {"earth": bounds(40.0, inf)}},
        {"solvers": {"half the step": bounds(32.0, inf)}},
        {"solvers": {"half the step": bounds(-inf, 35.0)}},
        {"solvers": {}},
        {"locked": bounds(95.0, inf)},
        {"locked": bounds(-inf, 96.0)},
        {"static": 97.1},
        {"static": 93.9},
        {"static": nan},
        {"mujoco": HEAVY.mujoco | {"earth": (37.0, 39.0)}},
        {"mujoco": HEAVY.mujoco | {"earth": (42.0, 43.0)}},
        {"mujoco": HEAVY.mujoco | {"earth": (35.0, 42.0)}},
        {"mujoco": HEAVY.mujoco | {"earth": (-inf, 40.0)}},
        {"mujoco": {"moon": (34.0, 36.0), "earth": (36.0, 40.0)}},
    ],
)
def test_each_part_of_the_mass_can_fail(change: dict[str, object]) -> None:
    assert not replace(HEAVY, **change).holds


def case(seed: int, reached: bool, *, straight: bool, climbs: bool = True, warnings: tuple[str, ...] = ()) -> Case:
    def climb(reached: bool) -> Climb:
        return Climb(heading=0.0, reached=reached, elevation=1.0, duration=100.0, distance=9.0)

    decision = Decision.__new__(Decision)  # Only its warnings matter here.
    object.__setattr__(decision, "warnings", warnings)
    return Case(seed, decision, climb(reached) if climbs else None, climb(straight))


def cases(reached: int, straight: int, refused: int = 0) -> tuple[Case, ...]:
    """Return ten cases; the first ones reach the rim, decided or straight on; the last ones see no way."""
    return tuple(case(k, k < reached, straight=k < straight, climbs=k < 10 - refused) for k in range(10))


WAY = HeadingAnswer(cases(9, 7), cases(9, 0), {0: {0.3: ["boulders"]}})


def test_decisions_that_reach_the_rim_hold() -> None:
    assert (WAY.straight, WAY.holds) == (7, True)


@pytest.mark.parametrize(
    "change",
    [
        {"cases": cases(8, 5)},
        {"cases": cases(9, 8)},
        {"cases": cases(9, 5, refused=2)},
        {"cases": ()},
        {"searched": cases(8, 0)},
        {"reasons": {0: {0.3: []}}},
        {"cases": (*cases(9, 5)[:9], case(9, True, straight=False, warnings=("no budget",)))},
    ],
)
def test_each_part_of_the_heading_can_fail(change: dict[str, object]) -> None:
    assert not replace(WAY, **change).holds
