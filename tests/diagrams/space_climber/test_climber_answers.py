"""Rows O4 and R1 of the table of answers can say no, for each of their parts."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from math import inf, nan
from pathlib import Path

import numpy as np
import pytest

from vtbdrake.optimization import Boundary
from vtbdrake_diagrams.space_climber.studies import perceived
from vtbdrake_diagrams.space_climber.studies.answers import GroundAnswer, HeadingAnswer, PayloadAnswer
from vtbdrake_diagrams.space_climber.studies.explorer import Stop
from vtbdrake_diagrams.space_climber.studies.perceived import (
    COMPARED,
    HEADINGS,
    Crossing,
    Walk,
    code_without_docstrings,
    crossings,
    digest,
    heading_name,
    imported_modules,
    judged,
    load,
    older,
    save,
)
from vtbdrake_diagrams.space_climber.studies.rover import FEW_ROCKS, MANY_ROCKS, Ground

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


def walk(seed: int, strategy: str, reached: bool, *, stands: bool = False) -> Walk:
    stop = Stop(4.0, (0.0, 0.0, 0.2), None if stands else 0.3)
    return Walk(seed, strategy, reached, 300.0, (41.5, 0.0, 6.2), "", (stop,) if strategy == "reasoned" else ())


def craters(reasoned: int, baseline: int, *, count: int = 100, refused: int = 0) -> tuple[Crossing, ...]:
    """Return craters; in the first ones a strategy reaches the rim; in the last ones the robot stands still."""
    crossings = []
    for k in range(count):
        walks = {name: walk(k, name, k < baseline) for name in ("surveyed route", "least slope", "straight")}
        walks["reasoned"] = walk(k, "reasoned", k < min(reasoned, count - refused), stands=k >= count - refused)
        crossings.append(Crossing(1300 + k, walks))
    return tuple(crossings)


def grounds(few: tuple[Crossing, ...], many: tuple[Crossing, ...]) -> dict[str, GroundAnswer]:
    return {"few rocks": GroundAnswer(few), "many rocks": GroundAnswer(many)}


WAY = HeadingAnswer(grounds(craters(95, 85), craters(85, 55)), {"straight in crater 1003": True})


def test_decisions_that_reach_the_rim_hold() -> None:
    assert (WAY.grounds["many rocks"].reached("straight"), WAY.together.gain, WAY.holds) == (55, 0.2, True)


@pytest.mark.parametrize(
    "change",
    [
        {"grounds": grounds(craters(95, 80), craters(84, 55))},  # too seldom
        {"grounds": grounds(craters(95, 85), craters(85, 56))},  # too little better
        {"grounds": grounds(craters(90, 91), craters(90, 40))},  # not better everywhere
        {"grounds": grounds(craters(95, 85), craters(100, 55, refused=16))},
        {"grounds": grounds(craters(95, 85), craters(99, 40, count=99))},
        {"grounds": grounds(craters(99, 85, count=99), craters(90, 40))},
        {"grounds": grounds(craters(95, 75), ())},
        {"grounds": {"few rocks": GroundAnswer(craters(95, 75))}},
        {"grounds": {}},
        {"repeated": {"straight in crater 1003": False}},
    ],
)
def test_each_part_of_the_heading_can_fail(change: dict[str, object]) -> None:
    assert not replace(WAY, **change).holds


def test_refusals_are_counted() -> None:
    assert GroundAnswer(craters(100, 60, refused=11)).refused == 11


def test_walks_are_kept_in_a_file(tmp_path: Path) -> None:
    path = tmp_path / "walks.jsonl"
    assert load(path) == ()
    walks = [walk(1001, "reasoned", True), walk(1000, "straight", False)]
    for each in walks:
        save(each, path)
    assert load(path) == tuple(walks)
    assert older(path) == 0
    path.write_text(path.read_text().replace(digest(), "another", 1))
    assert older(path) == 1
    path.write_text(path.read_text() + "{}\n")
    with pytest.raises(ValueError, match="line 3 of .* is no walk"):
        load(path)


def test_docstrings_and_comments_are_no_part_of_the_code(tmp_path: Path) -> None:
    path = tmp_path / "module.py"
    path.write_text('LEG = 20.0\n\n\nclass Stop:\n    def place(self):\n        return "x"\n')
    code = code_without_docstrings(path)
    path.write_text(
        '"""Stops."""\n\nLEG = 20.0  # in s\n"""How long."""\n\n\nclass Stop:\n    """A stop."""\n\n'
        '    def place(self):\n        """Return the place."""\n        return "x"\n'
    )
    assert code_without_docstrings(path) == code
    path.write_text(path.read_text().replace('"x"', '"y"'))
    assert code_without_docstrings(path) != code


@pytest.mark.slow
def test_the_digest_is_of_the_modules_that_python_imports() -> None:
    name = "vtbdrake_diagrams.space_climber.studies.perceived"
    program = f"import {name}, sys; print(*[m.__file__ for n, m in sys.modules.items() if 'space_climber.' in n])"
    output = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    imported = {Path(file).resolve() for file in output.split() if not file.endswith("__init__.py")}
    assert len(imported) > 15
    assert set(imported_modules(Path(perceived.__file__).resolve())) == imported


@pytest.mark.parametrize("ground", [FEW_ROCKS, MANY_ROCKS])
def test_a_crater_is_judged_when_some_fixed_heading_passes_and_all_have_walked(ground: Ground) -> None:
    seed = ground.first_seed
    names = [heading_name(heading) for heading in HEADINGS]
    failing = [replace(walk(seed, name, False), ground=ground.name) for name in (*names, *COMPARED)]
    (impassable,) = crossings(failing, ground)
    assert impassable.passable is False
    (open_question,) = crossings([each for each in failing if each.strategy != "45 deg"], ground)
    assert open_question.passable is None
    passing = [replace(each, reached=each.strategy == "45 deg") for each in failing]
    assert len(judged(passing, ground)) == 1
    assert judged(failing, ground) == judged([w for w in passing if w.strategy != "least slope"], ground) == ()
    assert judged([replace(each, seed=seed - 1) for each in passing], ground) == ()
    assert judged([replace(each, ground="another") for each in passing], ground) == ()
