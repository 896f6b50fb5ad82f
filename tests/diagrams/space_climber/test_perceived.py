"""Question R1 from perception to action: a robot decides at a stop, or stands still and says why."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.geometry import Box, Role
from pydrake.math import RigidTransform

from vtbdrake.common.scan import Scan
from vtbdrake.compiled import FixedPiece
from vtbdrake.components.world_model import WorldModel
from vtbdrake_diagrams.space_climber import CraterScenario
from vtbdrake_diagrams.space_climber.believed_scenario import believed_world, level_world
from vtbdrake_diagrams.space_climber.believed_terrain import BelievedTerrain
from vtbdrake_diagrams.space_climber.crater_scenario import X_BL
from vtbdrake_diagrams.space_climber.ground_map import GroundMap
from vtbdrake_diagrams.space_climber.standing_scanner import StandingScanner
from vtbdrake_diagrams.space_climber.studies.explorer import LEAST_GAIN, Explorer
from vtbdrake_diagrams.space_climber.studies.perceived import HEADINGS, LOOKING, Site, least_slope
from vtbdrake_diagrams.space_climber.studies.rover import (
    FEW_ROCKS,
    MANY_ROCKS,
    CompiledRover,
    Rover,
    combined_friction,
    compiled_world,
    true_world,
)
from vtbdrake_diagrams.space_climber.survey import survey
from vtbdrake_diagrams.space_climber.terrain import ROCK_DISTANCE, SECTOR, Crater, crater_shapes


def terrain(heights: np.ndarray) -> BelievedTerrain:
    ground = GroundMap.surveyed((-6.0, -34.0), 1.0, heights, deviation=0.3, range=8.0)
    return BelievedTerrain(ground, WorldModel())


FLAT = np.zeros((55, 69))


def standing(place: list[float], scan: Scan) -> SimpleNamespace:
    """Return a stand-in for a `Rover`, with a scan."""
    return SimpleNamespace(time=4.0, place=np.array(place), scan=lambda: scan, X_WL=lambda _: RigidTransform())


@pytest.mark.parametrize(
    ("place", "scan", "reason"),
    [
        ([0.0, 0.0], Scan.empty(), "no return"),
        ([0.0, 0.0], Scan(np.array([[0.0, 1.0, 0.0]]), np.array([30.0]), np.zeros(1), 0.0), "no return within"),
    ],
)
def test_a_robot_that_sees_nothing_stands_still_and_says_why(place: list[float], scan: Scan, reason: str) -> None:
    stop = Explorer(CraterScenario(), terrain(FLAT)).decide(standing(place, scan))
    assert stop.heading is None
    assert reason in stop.said


def test_a_robot_beside_its_map_stands_still_and_says_why() -> None:
    rover = standing([-20.0, 0.0], Scan.empty())
    rover.X_WL = lambda believed: RigidTransform([0.0, 0.0, float(believed.ground.height([rover.place])[0])])
    stop = Explorer(CraterScenario(), terrain(FLAT)).decide(rover)
    assert stop.heading is None
    assert "beside the map" in stop.said


def test_the_least_steep_heading_is_chosen_by_the_survey() -> None:
    """A wall of 1 m per metre from x = 20 m on, but for y > 12 m."""
    heights = FLAT.copy()
    heights[26:, :46] = np.arange(29.0)[:, None]
    assert np.degrees(least_slope(terrain(heights))) > 30.0
    assert least_slope(terrain(FLAT)) in HEADINGS


def test_unknown_strategies_are_named() -> None:
    with pytest.raises(ValueError, match="a strategy is one of reasoned, .*, not 'luck'"):
        Site(1).run("luck")


def test_kinds_of_ground_differ_in_their_rocks() -> None:
    """By area: the rocks of 0.12 m and more cover k exp(-q D), less what lies beside the field of the robot."""
    covers = {}
    for ground in (FEW_ROCKS, MANY_ROCKS):
        crater = true_world(1000, ground).crater
        assert crater.rock_cover == ground.rock_cover
        rocks = crater.blocks[len(replace(crater, rock_cover=0.0).blocks) :]
        areas = [0.25 * np.pi * rock.size[0] * rock.size[1] for rock in rocks]
        inner, outer = ROCK_DISTANCE
        covers[ground] = sum(areas) / (SECTOR * (outer**2 - inner**2))
        q = 1.79 + 0.152 / ground.rock_cover
        assert covers[ground] == pytest.approx(ground.rock_cover * np.exp(-0.12 * q), rel=0.25)
    assert covers[MANY_ROCKS] > 2.0 * covers[FEW_ROCKS]


def test_worlds_differ_from_what_the_robot_uses() -> None:
    """Nothing of the true crater is among the fields of the mental world."""
    world = true_world(7)
    prior = survey(world.crater, seed=0)
    mental = Explorer(world, BelievedTerrain(prior.ground, prior.rocks)).mental([0.0, 0.0])
    untouched = CraterScenario()
    for name in ("seed", "rock_cover", "waviness", "waviness_seed", "scans"):
        assert getattr(mental, name) == getattr(untouched, name)
        assert name in ("scans", "rock_cover") or getattr(world, name) != getattr(untouched, name)
    assert mental.friction == pytest.approx(0.54)


def test_pieces_of_a_believed_world_are_its_geometry_in_drake() -> None:
    """A robot that stands still in both, on a slope, is at the same place after 0.4 s."""
    heights = FLAT + 0.1 * np.arange(55.0)[:, None]
    world = terrain(heights).world_model(near=[3.3, 0.4], radius=3.0, datum=0.93)
    level = believed_world(CraterScenario(), level_world(), friction=0.5)
    pieces = {
        (round(float(p.X_WP.translation()[0]), 6), round(float(p.X_WP.translation()[1]), 6)): p
        for p in level.pieces(world)
    }
    testbed = replace(level, world=world).build()
    inspector = testbed.diagram.GetSubsystemByName("scene_graph").model_inspector()
    ids = inspector.GetGeometries(inspector.world_frame_id(), Role.kProximity)
    assert len(ids) == len(pieces) == 2 * len(world.find("ground"))
    for geometry in ids:
        X_WG = inspector.GetPoseInFrame(geometry)
        piece = pieces[round(float(X_WG.translation()[0]), 6), round(float(X_WG.translation()[1]), 6)]
        np.testing.assert_array_equal(piece.X_WP.GetAsMatrix34(), X_WG.GetAsMatrix34())
        np.testing.assert_array_equal(
            piece.shape.GetConvexHull().CalcBoundingBox()[1], inspector.GetConvexHull(geometry).CalcBoundingBox()[1]
        )
    assert replace(level, world=world).ground_height(3.3, 0.4) == pytest.approx(0.0, abs=1e-9)


def test_ground_for_other_feet_has_the_friction_that_is_asked_for() -> None:
    """Drake combines a and b to 2 a b / (a + b)."""
    feet, wanted = 0.62, 0.55
    ground = combined_friction(wanted, feet)
    assert 2.0 * feet * ground / (feet + ground) == pytest.approx(wanted)


def test_a_standing_scanner_sees_what_the_testbeds_scanner_sees() -> None:
    """On the level floor, without rocks near, ranges follow from the height and the elevation of each ray."""
    scan = StandingScanner(Crater(1, boulders=False)).scan(RigidTransform([0.0, 0.0, 0.2]), 5.0)
    X_WL = RigidTransform([0.0, 0.0, 0.2]) @ X_BL
    points = (X_WL @ scan.points().T).T
    near = np.hypot(*points[:, :2].T) < 6.0
    assert near.sum() > 1000
    # The noise of a range is 12 mm, and less in height at grazing rays.
    assert np.abs(points[near, 2]).max() < 5.0 * 0.012
    assert scan.stamp == pytest.approx(5.0, abs=0.21)


@pytest.mark.slow
@pytest.mark.one_python
def test_a_robot_looks_tries_and_decides() -> None:
    """The mental world is compiled, which takes a minute of the C compiler once."""
    world = replace(true_world(1), boulders=False)
    rover = Rover(world.build(), mass=1.0)
    prior = survey(world.crater, seed=0)
    explorer = Explorer(world, BelievedTerrain(prior.ground, prior.rocks))
    before = np.abs(explorer.terrain.ground.height([[4.0, 0.0]])[0] - explorer.terrain.ground.height([[0.0, 0.0]])[0])
    rover.advance(LOOKING, walk=0.0)
    stop = explorer.decide(rover)
    after = np.abs(explorer.terrain.ground.height([[4.0, 0.0]])[0] - explorer.terrain.ground.height([[0.0, 0.0]])[0])
    # The floor is flat, and the survey's error of 0.3 m is not there where it has looked.
    assert after < min(before, 0.15)
    assert stop.said == ""
    gains = {heading: gain for heading, walk, gain in stop.tried if walk == 1.0}
    assert stop.heading == max(gains, key=gains.__getitem__)
    assert gains[stop.heading] > LEAST_GAIN
    rover.advance(12.0, heading=stop.heading, walk=1.0)
    way = rover.place
    assert np.arctan2(way[1], way[0]) == pytest.approx(stop.heading, abs=0.5)


class DeadEnd(Site):
    """A crater without boulders; across the way stand walls, open towards the robot, that the scanner does not see."""

    WALLS = (
        (Box(0.6, 2.4, 1.2), [6.0, 0.0, 0.0]),
        (Box(0.6, 0.3, 1.2), [5.4, 1.05, 0.0]),
        (Box(0.6, 0.3, 1.2), [5.4, -1.05, 0.0]),
    )

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.world = replace(self.world, boulders=False, gullies=False, waviness=0.0)
        self.terrain = BelievedTerrain(survey(self.world.crater, seed=0).ground, WorldModel())

    def rover(self) -> CompiledRover:
        pieces = [FixedPiece(shape, X_WS, 0.6) for _, shape, X_WS in crater_shapes(self.world.crater)]
        pieces += [FixedPiece(box, RigidTransform(place), 0.6) for box, place in self.WALLS]
        terrain = compiled_world()[1].terrain(pieces)
        return CompiledRover(self.world, terrain, StandingScanner(self.world.crater), mass=1.0)


@pytest.mark.slow
@pytest.mark.one_python
def test_a_robot_goes_back_from_a_dead_end_and_around_it() -> None:
    """Straight on, it stays in there for good; nothing that it sees tells why."""
    site = DeadEnd(2)
    ahead = site.fixed(0.0)
    # Its front feet are 0.4 m ahead of its middle, and the wall begins at 5.7 m.
    assert 5.0 < ahead.end[0] < 5.7
    assert not ahead.reached
    walk = site.explore()
    assert walk.reached
