"""Pictures of decisions: what is drawn for each candidate, and the poses of its motion."""

import numpy as np
import pytest
from matplotlib.colors import to_hex
from pydrake.geometry import Meshcat

from tests.reasoning.scenarios import MassScenario, SwingUpScenario
from tests.visualization.meshcat_page import messages
from tests.visualization.scenes.reading import read_mcap
from vtbdrake.optimization import Parameter
from vtbdrake.reasoning import Belief, Budget, Reasoner, SearchConfig
from vtbdrake.rollout import Constraint, Quality
from vtbdrake.visualization import (
    decision_ghosts,
    make_meshcat,
    plot_decision,
    show_decision,
    show_poses,
    write_scene,
)

ANGLE = "sim.sys.Pendulum.theta.position"
UPRIGHT = Quality(lambda q: 1.0 - np.cos(q), of=ANGLE)


@pytest.fixture(scope="module")
def swung_up():
    reasoner = Reasoner(
        scenario=SwingUpScenario(),
        decision=[Parameter("u.switch", 0.0, 2.0)],
        quality=UPRIGHT,
        horizon=2.0,
        sample_period=0.1,
        budget=Budget(rollouts=6),
        constraints=[Constraint(lambda q: abs(q), of=ANGLE, at_most=6.0)],
        search=SearchConfig(method="grid", options={"points": 5}, executor="serial"),
    )
    testbed = reasoner.problem.testbed
    with reasoner:
        yield reasoner, reasoner.decide(Belief.perfect(testbed, testbed.default_context()))


@pytest.fixture(scope="module")
def meshcat() -> Meshcat:
    return make_meshcat()


def test_each_candidate_is_drawn_over_time_and_over_its_value(swung_up):
    _, decision = swung_up
    left, right = plot_decision(decision).axes
    drawn = [line for line in left.get_lines() if line.get_gid() == "trajectory"]
    assert len(drawn) == len(decision.candidates) == 5
    expected = {(float(c.values["u.switch"]), c.quality) for c in decision.candidates}
    assert {tuple(line.get_xydata()[0]) for line in right.get_lines()} == expected


def test_the_chosen_candidate_is_drawn_last_as_a_star(swung_up):
    _, decision = swung_up
    left, right = plot_decision(decision).axes
    star = right.get_lines()[-1]
    assert star.get_marker() == "*"
    assert star.get_ydata()[0] == max(c.quality for c in decision.candidates if c.status == "eligible")
    (plan_in_use,) = [line for line in right.get_lines() if line.get_marker() == "s"]
    first = decision.candidates[0]
    assert tuple(plan_in_use.get_xydata()[0]) == (first.values["u.switch"], first.quality)
    curve = [line for line in left.get_lines() if line.get_gid() == "trajectory"][-1]
    np.testing.assert_array_equal(curve.get_ydata(), decision.candidates[decision.chosen].rollouts[0].quality)


def test_several_decided_elements_are_drawn_in_the_order_of_trying():
    miss = Quality(lambda state: abs(state[0] - 1.0), of="sim.sys.mass.y0", minimize=True, reading="end")
    with Reasoner(
        scenario=MassScenario(),
        decision=[Parameter("u.switch", 0.0, 3.0), Parameter("dps.estimate[0]", 0.0, 1.0)],
        quality=miss,
        horizon=3.0,
        sample_period=0.5,
        budget=Budget(rollouts=8),
        search=SearchConfig(method="random", executor="serial"),
    ) as reasoner:
        testbed = reasoner.problem.testbed
        decision = reasoner.decide(Belief.perfect(testbed, testbed.default_context()))
    _, right = plot_decision(decision).axes
    (best,) = [line for line in right.get_lines() if line.get_gid() == "best"]
    np.testing.assert_array_equal(best.get_xdata(), np.arange(8))
    assert (np.diff(best.get_ydata()) <= 0.0).all()
    assert best.get_ydata()[-1] == decision.quality


def test_the_motion_of_a_candidate_is_that_of_its_rollout(swung_up):
    reasoner, decision = swung_up
    motion = reasoner.motion(decision, decision.chosen)
    rollout = decision.candidates[decision.chosen].rollouts[0]
    np.testing.assert_array_equal(1.0 - np.cos(motion.states[:, 0]), rollout.quality)


def _objects(meshcat: Meshcat, path: str) -> dict[str, dict]:
    found = [m for m in messages(meshcat.StaticHtml()) if m["type"] == "set_object"]
    return {m["path"]: m for m in found if m["path"].startswith(f"/drake/{path}")}


def test_ghosts_are_transparent_and_the_chosen_one_is_solid(swung_up, meshcat):
    reasoner, decision = swung_up
    scene = show_decision(meshcat, reasoner, decision, most=3, count=4)
    assert len(scene.legend) == 3 and "0 (plan in use)" in scene.legend
    opacities = {
        label: {o["object"]["materials"][0]["opacity"] for o in _objects(meshcat, f"decision/{label}/").values()}
        for label in scene.legend
    }
    chosen = next(label for label in scene.legend if label.split()[0] == str(decision.chosen))
    assert opacities == {label: {1.0 if label == chosen else 0.35} for label in scene.legend}
    assert len({to_hex(color) for color in scene.legend.values()}) == 3


def test_poses_are_those_of_the_motion_at_equal_intervals(swung_up, meshcat):
    reasoner, decision = swung_up
    motion = reasoner.motion(decision, 1)
    show_poses(meshcat, {"swing": motion}, count=5)
    transforms = {m["path"]: m["matrix"] for m in messages(meshcat.StaticHtml()) if m["type"] == "set_transform"}
    shown: dict[str, np.ndarray] = {}
    for path in sorted(path for path in transforms if path.startswith("/drake/poses/swing/")):
        # The arm's frame comes before its first geometry.
        if "arm" in path:
            shown.setdefault(path.split("/")[4], np.reshape(transforms[path], (4, 4)).T)
    angles = {int(k): np.arctan2(X[0, 2], X[0, 0]) for k, X in shown.items()}
    expected = motion.states[np.linspace(0, len(motion.times) - 1, 5).round().astype(int), 0]
    np.testing.assert_allclose(np.cos([angles[k] for k in range(5)]), np.cos(expected), atol=1e-6)


def test_a_scene_without_instants_or_candidates_is_refused(swung_up, meshcat):
    reasoner, decision = swung_up
    with pytest.raises(ValueError, match="one candidate is shown at least, not 0"):
        show_decision(meshcat, reasoner, decision, most=0)
    with pytest.raises(ValueError, match="at one instant at least, not at 0"):
        show_poses(meshcat, {"swing": reasoner.motion(decision, 1)}, count=0)


def test_candidates_are_ghosts_in_a_scene_in_their_colours(swung_up, tmp_path):
    reasoner, decision = swung_up
    write_scene(decision_ghosts(reasoner, decision, most=3), tmp_path / "decision.mcap")
    messages = read_mcap(tmp_path / "decision.mcap")
    scenes = {
        topic.split("/")[1]: message.entities
        for topic in messages
        for _, message in messages[topic][:1]
        if topic.endswith("/scene")
    }
    assert len(scenes) == 3 and str(decision.chosen) in scenes and "0 (plan in use)" in scenes
    opacities = {}
    for label, entities in scenes.items():
        [arm] = [entity for entity in entities if entity.id == f"{label}/Pendulum/arm"]
        opacities[label] = arm.cylinders[0].color.a
        motion = reasoner.motion(decision, int(label.partition(" ")[0]))
        positions = [message.joints[0].position for _, message in messages[f"/{label}/joint_states"]]
        assert positions == motion.states[:, 0].tolist()
    assert opacities == pytest.approx({label: 1.0 if label == str(decision.chosen) else 0.35 for label in scenes})
