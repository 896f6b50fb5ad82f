"""Recorded arms and legs against published models, on movements that were not fitted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.real import recordings
from vtbdrake.calibration import TorqueRegressor, regress
from vtbdrake_diagrams.recorded_arms import pendulum, plants, subjects
from vtbdrake_diagrams.recorded_arms.reality import compared, relative
from vtbdrake_diagrams.recorded_arms.subjects import Subject

pytestmark = pytest.mark.one_python


def folder(name: str) -> Path:
    return recordings(name)[0]


def test_kr300_is_its_designers_model() -> None:
    # Their own code (gravload_200.m, inertia_200.m) at this posture, with 200 kg; its axis 3 has another zero.
    q = np.random.default_rng(0).uniform(-1.0, 1.0, 6) + np.array([0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0])
    gravity = [0.0, -6244.77, -987.79, -67.57, -466.4, 0.0]
    inertia = [1973.61, 2476.92, 1169.43, 93.23, 122.96, 41.2]
    gears = np.array([1798 / 7, 1872 / 7, 757 / 3, 221.0, 5032 / 21, 206793 / 1340])
    rotors = np.array([0.00923, 0.0118, 0.0118, 0.00173, 0.00173, 0.00173]) * gears**2
    model = TorqueRegressor(plants.kr300(200.0), drives={})
    rest = np.zeros((7, 6))
    torques = model.matrix(np.tile(q, (7, 1)), rest, np.vstack([np.zeros(6), np.eye(6)])) @ model.nominal
    np.testing.assert_allclose(torques[0], gravity, atol=0.01)
    np.testing.assert_allclose(np.diag(torques[1:] - torques[0]) + rotors, inertia, atol=0.01)


def test_pendulum_is_what_was_weighed_and_not_what_was_published() -> None:
    data = folder("dfki_simple_pendulum")
    result, models = pendulum.models(data)
    center = result.parameters[f"{pendulum.BODY}.center_of_mass[2]"]
    guess, (mass, length) = pendulum.TorqueLimitedPendulumScenario().mass, pendulum.WEIGHED
    low, high = -center.upper * guess, -center.lower * guess
    assert low < mass * length < high
    assert low > pendulum.PUBLISHED.moment
    repeated = models["their procedure"]
    assert (repeated.J, repeated.moment) == pytest.approx((0.06259, 0.1022), abs=1e-4)
    errors = {name: pendulum.median_errors(data, model) for name, model in models.items()}
    assert np.max(errors["calibrated"]) < 0.5 * np.min(errors["published"])
    assert np.max(errors["as weighed"]) < np.min(errors["calibrated"])


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("read", "published"),
    [
        (lambda: subjects.panda(folder("panda_gaz2019")), "Gaz 2019"),
        (lambda: subjects.tiago(folder("figaroh")), "URDF, friction fitted"),
        (lambda: subjects.kr300(folder("kuka_kr300"))["A"], "designers"),
        (lambda: subjects.kr300(folder("kuka_kr300"))["B"], "designers"),
        (lambda: subjects.kr300(folder("kuka_kr300"))["C"], "designers"),
        (lambda: subjects.go2(folder("go2_leg"))["FL"], "public model"),
    ],
    ids=["panda", "tiago", "kr300-A", "kr300-B", "kr300-C", "go2"],
)
def test_other_movements_are_explained_better_than_by_the_published_model(read, published: str) -> None:
    subject: Subject = read()
    shares = relative(compared(subject))
    assert shares["ours, of real bodies"] < shares[published]


@pytest.mark.slow
def test_tx40_is_explained_better_only_if_both_have_seen_the_movement() -> None:
    shares = relative(compared(subjects.tx40(folder("figaroh"))))
    assert shares["ours, fitted to all"] < shares["FIGAROH"] < shares["ours, of real bodies"]


def test_friction_of_tx40_is_that_of_figaroh() -> None:
    subject = subjects.tx40(folder("figaroh"))
    fit = regress(subject.model, subject.fitted, block=subject.block)
    # figaroh-plus, examples/staubli_TX40/results/TX40_ep_5.csv; motor 6 turns with joints 5 and 6.
    published = {"link1.viscous": 8.03, "link1.coulomb": 7.23, "link2.viscous": 5.52, "wrist.viscous": 0.609}
    for name, value in published.items():
        assert fit.values[fit.names.index(name)] == pytest.approx(value, rel=0.1), name
