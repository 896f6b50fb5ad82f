"""The changes of a map, in the world model that it came from, and in the mental plant that is built from it."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from vtbdrake.common.arrays import Array
from vtbdrake.components.localization.constellation import ConstellationMap
from vtbdrake.components.localization.landmarks import Landmarks, map_landmarks
from vtbdrake.components.localization.revision import MapChanges
from vtbdrake.components.localization.tracking import Tracker
from vtbdrake.components.localization.unit import LocalizationUnit
from vtbdrake.components.localization.write_back import written_back
from vtbdrake.components.world_model import WorldModel, add_to_plant
from vtbdrake_diagrams.forest.studies.detections import Detector
from vtbdrake_diagrams.forest.studies.drive import memories, simulated_drive
from vtbdrake_diagrams.forest.world.stand import Stand

pytestmark = pytest.mark.one_python


def trunks_in_plant(model: WorldModel) -> Array:
    """Return where the trunks of the plant stand that is built from a model, (n, 2) in m."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.01)
    add_to_plant(plant, model)
    plant.Finalize()
    inspector = scene_graph.model_inspector()
    ids = plant.GetCollisionGeometriesForBody(plant.world_body())
    return np.array([inspector.GetPoseInFrame(each).translation()[:2] for each in ids])


def landmarks(*places: tuple[float, float]) -> Landmarks:
    n = len(places)
    P = np.tile([[0.04, 0.01], [0.01, 0.09]], (n, 1, 1))
    return Landmarks(np.array(places).reshape(-1, 2), P, np.full(n, 0.3), np.full(n, 0.02))


def test_tree_that_the_survey_lacks_stands_in_the_mental_plant() -> None:
    stand = Stand(seed=2, length=40.0, width=40.0, density=700.0)
    drive = simulated_drive(stand, seed=2, length=4.0, detector=Detector(false=0.0), scans=2.0)
    true = stand.trees()
    lacking = true.nearest([*drive.truth[4, :2], 0.0])[0]
    survey = true.without([lacking.identity])
    mapped = map_landmarks(survey).widened(0.05)
    unit = LocalizationUnit(ConstellationMap(mapped), Tracker(mapped, revises=True))
    *_, last = memories(drive, unit)
    revised = written_back(survey, unit.tracker.changes(last.track), time=4.0)

    def gap(model: WorldModel) -> float:
        return float(np.hypot(*(trunks_in_plant(model) - lacking.p_WoOo_W[:2]).T).min())

    # Trees of a stand are a metre apart.
    assert gap(survey) > 0.9
    assert gap(revised) < 0.15
    assert len(revised) == len(true)


def test_changes_keep_covariances_and_identities() -> None:
    survey = Stand(seed=1, length=20.0, width=20.0, density=300.0).trees()
    identities = [tree.identity for tree in survey]
    changes = MapChanges(landmarks((3.0, 4.0)), np.array([5]), landmarks((1.0, 2.0)), np.array([2]))
    revised = written_back(survey, changes, time=7.0)
    assert len(trunks_in_plant(revised)) == len(survey)  # One more, and one less.
    assert not revised[identities[5]].is_known and survey[identities[5]].is_known
    added = revised["tree#1"]
    for changed, place in ((added, (3.0, 4.0)), (revised[identities[2]], (1.0, 2.0))):
        assert changed.p_WoOo_W[:2] == pytest.approx(place)
        assert changed.pose.covariance[3:5, 3:5] == pytest.approx(np.array([[0.04, 0.01], [0.01, 0.09]]))
        assert changed.number("trunk_diameter", unit="m") == 0.3
        assert changed.pose.time == 7.0
    assert added.pose.covariance[5, 5] == np.inf
    # What is written back is a map again.
    assert len(map_landmarks(revised)) == len(survey)


def test_changes_of_another_map_are_refused() -> None:
    survey = Stand(seed=1, length=20.0, width=20.0, density=300.0).trees()
    changes = MapChanges(landmarks(), np.array([len(survey)]), landmarks(), np.zeros(0, dtype=np.intp))
    with pytest.raises(ValueError, match="must be made of this model"):
        written_back(survey, changes, time=0.0)
