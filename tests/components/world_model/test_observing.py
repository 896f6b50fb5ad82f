"""Tests of association against exhaustive search, of fusion against least squares, and of the life cycle."""

from itertools import permutations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from scipy.stats import chi2

from vtbdrake.components.perception.estimate import PoseEstimate, rotation_matrix
from vtbdrake.components.world_model import (
    AttributeValue,
    LifeCycleConfig,
    Sighting,
    WorldModel,
    WorldObject,
    associate,
    fused,
    mahalanobis,
    observe,
    position_estimate,
)

pytestmark = pytest.mark.one_python


def tree(identity: str, xyz: object, *, deviation: object = 0.1, **fields: object) -> WorldObject:
    return WorldObject(identity, "tree", position_estimate(xyz, deviation=deviation), **fields)


def seen(xyz: object, *, deviation: object = 0.1, kind: str = "tree", diameter: float | None = None) -> Sighting:
    attributes = {} if diameter is None else {"trunk_diameter": AttributeValue(diameter, "m", 0.02)}
    return Sighting(kind, position_estimate(xyz, deviation=deviation), attributes=attributes)


def covariance(rng: np.random.Generator, size: int) -> np.ndarray:
    root = rng.normal(size=(size, size))
    return root @ root.T + 0.1 * np.eye(size)


def exhaustive(objects: list[WorldObject], sightings: list[Sighting], probability: float) -> float:
    """The least sum of d² and gates over all one-to-one assignments."""
    best = np.inf
    slots = [*range(len(objects)), *[None] * len(sightings)]
    for places in set(permutations(slots, len(sightings))):
        total = 0.0
        for sighting, place in zip(sightings, places, strict=True):
            gate = chi2.ppf(probability, 3)
            distance = np.inf if place is None else mahalanobis(objects[place], sighting)[0]
            total += distance if distance < gate else gate if place is None else np.inf
        best = min(best, total)
    return best


@pytest.mark.slow_cases
@pytest.mark.parametrize("seed", range(8))
def test_association_equals_exhaustive_search(seed: int) -> None:
    rng = np.random.default_rng(seed)
    objects = [tree(f"t{k}", rng.uniform(0, 1.0, 3), deviation=rng.uniform(0.05, 0.4, 3)) for k in range(4)]
    sightings = [seen(rng.uniform(0, 1.0, 3), deviation=rng.uniform(0.05, 0.4, 3)) for _ in range(3)]
    pairs = associate(objects, sightings, probability=0.99)
    assert len(set(pairs.values())) == len(pairs)
    total = sum(mahalanobis(objects[j], sightings[i])[0] for i, j in pairs.items())
    total += (len(sightings) - len(pairs)) * chi2.ppf(0.99, 3)
    assert total == pytest.approx(exhaustive(objects, sightings, 0.99), rel=1e-12)


def test_gate_passes_the_stated_share_of_right_pairs() -> None:
    rng = np.random.default_rng(5)
    objects = [tree(f"t{k}", [10.0 * k, 0.0, 0.0], deviation=[0.3, 0.1, 0.2]) for k in range(1000)]
    spread = np.hypot([0.3, 0.1, 0.2], 0.2)
    sightings = [seen(one.p_WoOo_W + spread * rng.normal(size=3), deviation=0.2) for one in objects]
    share = len(associate(objects, sightings, probability=0.95)) / 1000
    assert share == pytest.approx(0.95, abs=3.0 * np.sqrt(0.95 * 0.05 / 1000))


def test_diameter_tells_neighbours_apart() -> None:
    thin = tree("thin", [0.0, 0.0, 0.0], attributes={"trunk_diameter": AttributeValue(0.1, "m", 0.02)})
    thick = tree("thick", [0.2, 0.0, 0.0], attributes={"trunk_diameter": AttributeValue(0.4, "m", 0.02)})
    assert associate([thin, thick], [seen([0.02, 0.0, 0.0], diameter=0.38)]) == {0: 1}
    assert associate([thin, thick], [seen([0.02, 0.0, 0.0], diameter=0.12)]) == {0: 0}
    assert associate([thin, thick], [seen([0.02, 0.0, 0.0], kind="rock")]) == {}


def test_unknown_height_is_not_compared() -> None:
    one = tree("t", [0.0, 0.0, 7.0], deviation=[0.1, 0.1, 0.1])
    flat = seen([0.1, 0.0, 0.0], deviation=[0.1, 0.1, np.inf])
    assert mahalanobis(one, flat) == (pytest.approx(0.01 / 0.02), 2)
    assert associate([one], [flat]) == {0: 0}


def test_fusion_of_positions_is_weighted_least_squares() -> None:
    rng = np.random.default_rng(2)
    P, R = np.diag([np.inf] * 6), np.diag([np.inf] * 6)
    P[3:, 3:], R[3:, 3:] = covariance(rng, 3), covariance(rng, 3)
    prior = PoseEstimate.of(RigidTransform(rng.normal(size=3)), P, time=1.0)
    measured = PoseEstimate.of(RigidTransform(rng.normal(size=3)), R, time=2.0)
    result = fused(prior, measured)
    W1, W2 = np.linalg.inv(P[3:, 3:]), np.linalg.inv(R[3:, 3:])
    information = W1 + W2
    expected = np.linalg.solve(information, W1 @ prior.matrix[:, 3] + W2 @ measured.matrix[:, 3])
    assert np.allclose(result.matrix[:, 3], expected, atol=1e-12)
    assert np.allclose(result.covariance[3:, 3:], np.linalg.inv(information), atol=1e-12)
    assert np.isinf(np.diag(result.covariance)[:3]).all() and result.time == 2.0


@pytest.mark.parametrize("first", [(3, 4), (3, 4, 5), (5,), (0, 1, 2, 3, 4, 5), (0, 1, 2, 4)])
@pytest.mark.parametrize("second", [(3, 4), (0, 1, 2, 3, 4, 5), (4, 5)])
def test_fusion_adds_the_information_of_what_each_knows(first: tuple[int, ...], second: tuple[int, ...]) -> None:
    rng = np.random.default_rng(4)
    estimates, information, vector = [], np.zeros((6, 6)), np.zeros(6)
    for known in (first, second):
        part = np.ix_(known, known)
        P = np.diag(np.full(6, np.inf))
        P[part] = 1e-6 * covariance(rng, len(known))
        delta = 1e-6 * rng.normal(size=6)
        X = RigidTransform(np.column_stack([rotation_matrix(delta[:3]), delta[3:]]))
        estimates.append(PoseEstimate.of(X, P, time=0.0))
        block = np.zeros((6, 6))
        block[part] = np.linalg.inv(P[part])
        information += block
        vector += block @ delta
    known = sorted({*first, *second})
    part = np.ix_(known, known)
    result = fused(*estimates)
    assert np.allclose(result.covariance[part], np.linalg.inv(information[part]), rtol=1e-6, atol=1e-15)
    delta = PoseEstimate.of(RigidTransform(), np.eye(6), time=0.0).error_to(result.X)
    assert np.allclose(delta[known], np.linalg.solve(information[part], vector[known]), atol=1e-9)
    assert np.isinf(np.delete(np.diag(result.covariance), known)).all()


def test_exact_prior_is_not_moved() -> None:
    result = fused(position_estimate([1.0, 2.0, 3.0]), position_estimate([2.0, 2.0, 2.0], deviation=0.1))
    assert result.matrix[:, 3].tolist() == [1.0, 2.0, 3.0] and not result.covariance[3:, 3:].any()


def test_model_of_many_updates_is_consistent() -> None:
    """The normalized estimation error squared (NEES) of 80 trees, seen ten times, against its 99.9 % bounds."""
    rng = np.random.default_rng(6)
    truth = np.column_stack([np.repeat(np.arange(8), 10) * 4.0, np.tile(np.arange(10), 8) * 4.0, np.zeros(80)])
    mapped = truth + rng.normal(size=(80, 3)) * [0.35, 0.35, 0.2]
    model = WorldModel([tree(f"t{k}", place, deviation=[0.35, 0.35, 0.2]) for k, place in enumerate(mapped)])
    sigma = np.array([0.1, 0.05, 0.3])
    for _ in range(10):
        sightings = [seen(place + sigma * rng.normal(size=3), deviation=sigma) for place in truth]
        model = observe(model, sightings, rules=LifeCycleConfig(gate=1.0 - 1e-9))
    assert len(model) == 80
    errors = [model[f"t{k}"].p_WoOo_W - truth[k] for k in range(80)]
    nees = sum(e @ np.linalg.solve(model[f"t{k}"].pose.covariance[3:, 3:], e) for k, e in enumerate(errors))
    low, high = chi2.ppf([0.0005, 0.9995], 240)
    assert low < nees < high


def test_pose_with_rotation_is_consistent() -> None:
    rng = np.random.default_rng(7)
    total, runs = 0.0, 200
    for _ in range(runs):
        X = RigidTransform(RollPitchYaw(rng.uniform(-1, 1, 3)), rng.normal(size=3))
        estimates = []
        for _ in range(4):
            P = 1e-4 * covariance(rng, 6)
            delta = np.linalg.cholesky(P) @ rng.normal(size=6)
            # The true pose is the estimated one, moved by δ.
            R = rotation_matrix(-delta[:3]) @ X.rotation().matrix()
            matrix = np.column_stack([R, X.translation() - delta[3:]])
            estimates.append(PoseEstimate(matrix, P, 0.0))
        result = estimates[0]
        for other in estimates[1:]:
            result = fused(result, other)
        delta = result.error_to(X)
        total += delta @ np.linalg.solve(result.covariance, delta)
    assert chi2.ppf(0.001, 6 * runs) < total < chi2.ppf(0.999, 6 * runs)


def test_object_is_confirmed_by_hits() -> None:
    model = WorldModel()
    history = []
    for _ in range(3):
        model = observe(model, [seen([0.0, 0.0, 0.0])])
        history.append((len(model), next(iter(model)).status))
    assert history == [(1, "tentative"), (1, "tentative"), (1, "confirmed")]
    assert next(iter(model)).pose.covariance[3, 3] == pytest.approx(0.01 / 3)


def test_clutter_is_forgotten_and_its_name_not_used_again() -> None:
    model = observe(WorldModel(), [seen([0.0, 0.0, 0.0])])
    (clutter,) = model
    for _ in range(2):
        model = observe(model, [], expected=[one.identity for one in model])
    assert len(model) == 0
    (other,) = observe(model, [seen([0.0, 0.0, 0.0])])
    assert other.identity != clutter.identity


def test_missing_tree_is_retired_and_stays_as_such() -> None:
    model = WorldModel([tree("t", [0.0, 0.0, 0.0])])
    for _ in range(7):
        model = observe(model, [], expected=["t"])
    assert model["t"].status == "confirmed"
    recovered = observe(model, [seen([0.0, 0.0, 0.0])], expected=["t"])
    assert recovered["t"].misses == 0
    model = observe(model, [], expected=["t"])
    assert model["t"].status == "retired" and not model["t"].is_known
    assert observe(model, [], expected=["t"])["t"] is model["t"]
    assert [one.status for one in observe(model, [seen([0.0, 0.0, 0.0])])] == ["retired", "tentative"]


def test_displaced_tree_is_revised() -> None:
    model = WorldModel([tree("t", [0.0, 0.0, 0.0], deviation=0.05)])
    for count in range(1, 3):
        model = observe(model, [seen([0.8, 0.0, 0.0], deviation=0.05)], expected=["t"])
        assert len(model) == 1 and model["t"].conflicts == count and model["t"].p_WoOo_W[0] == 0.0
    model = observe(model, [seen([0.8, 0.0, 0.0], deviation=0.05)], expected=["t"])
    assert model["t"].status == "revised" and model["t"].p_WoOo_W[0] == 0.8
    model = observe(model, [seen([0.82, 0.0, 0.0], deviation=0.05)], expected=["t"])
    assert model["t"].p_WoOo_W[0] == pytest.approx(0.81) and model["t"].hits == 2


def test_object_out_of_sight_is_left_alone() -> None:
    model = WorldModel([tree("t", [0.0, 0.0, 0.0])])
    assert observe(model, [])["t"] is model["t"]
    with pytest.raises(KeyError, match="no object 'x'"):
        observe(model, [], expected=["x"])


def test_attributes_are_fused() -> None:
    known = {
        "trunk_diameter": AttributeValue(0.30, "m", 0.02),
        "species": AttributeValue("pine"),
        "height": AttributeValue(20.0, "m"),
    }
    model = WorldModel([tree("t", [0.0, 0.0, 0.0], attributes=known)])
    after = observe(model, [seen([0.0, 0.0, 0.0], diameter=0.34)])["t"].attributes
    assert after["trunk_diameter"].value == pytest.approx(0.32)
    assert after["trunk_diameter"].deviation == pytest.approx(0.02 / np.sqrt(2.0))
    assert after["species"].value == "pine" and after["height"].value == 20.0


@pytest.mark.parametrize("deviation", [0.02, 0.0])
def test_units_of_a_sighting_must_agree(deviation: float) -> None:
    one = tree("t", [0.0, 0.0, 0.0], attributes={"trunk_diameter": AttributeValue(0.3, "rad", deviation)})
    with pytest.raises(ValueError, match="in rad, but was seen in m"):
        observe(WorldModel([one]), [seen([0.0, 0.0, 0.0], diameter=0.3)])


def test_sighting_without_an_uncertainty_is_refused() -> None:
    with pytest.raises(ValueError, match="positive definite"):
        seen([0.0, 0.0, 0.0], deviation=0.0)
    with pytest.raises(ValueError, match="a position at least"):
        seen([0.0, 0.0, 0.0], deviation=np.inf)


def test_objects_are_no_sightings() -> None:
    known = tree("t", [0.0, 0.0, 0.0], deviation=0.0)
    with pytest.raises(ValueError, match="of the class Sighting, not WorldObject: give"):
        observe(WorldModel([known]), [known])
