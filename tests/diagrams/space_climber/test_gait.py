"""Gaits against what defines them; the steady walk's closed form is written out here."""

from __future__ import annotations

import casadi
import numpy as np
import pytest

from vtbdrake_diagrams.space_climber.gait import GAITS, Gait, glide, lift
from vtbdrake_diagrams.space_climber.morphology import Morphology

NOMINAL = Morphology().stance[:, :2].copy()
STEPS = 60  # a cycle; every duty factor is a whole number of steps


def leg_phases(gait: Gait, phase: float) -> list[float]:
    return gait.leg_phases(phase).full().ravel().tolist()


def stepper(gait: Gait) -> casadi.Function:
    """The step (feet, phase, next_phase, forward, turn) -> feet as a function of numbers."""
    feet = casadi.SX.sym("feet", 6, 2)
    named = {name: casadi.SX.sym(name) for name in ("phase", "next_phase", "forward", "turn")}
    after = gait.advanced(feet, nominal=casadi.DM(NOMINAL), stance_steps=gait.duty * STEPS, **named)
    return casadi.Function("step", [feet, *named.values()], [after])


def walk(gait: Gait, *, forward: float, turn: float = 0.0, cycles: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Phases (n,) and feet (n, 6, 2) of the last of ``cycles`` cycles of constant steps (forward m, turn rad)."""
    step, feet = stepper(gait), NOMINAL.copy()
    phases, path = [], []
    for k in range(cycles * STEPS):
        feet = step(
            feet,
            k / STEPS,
            (k + 1) / STEPS,
            forward,
            turn,
        ).full()
        phases.append((k + 1) / STEPS)
        path.append(feet.copy())
    return np.array(phases[-STEPS:]), np.array(path[-STEPS:])


@pytest.mark.parametrize("name", GAITS)
def test_number_of_standing_feet(name: str) -> None:
    gait = GAITS[name]
    for phase in np.linspace(0, 1, 97, endpoint=False) + 1e-3:
        standing = sum(leg < gait.duty for leg in leg_phases(gait, phase))
        assert standing == {"tripod": 3, "ripple": 4, "wave": 5}[name]


@pytest.mark.parametrize("name", GAITS)
def test_standing_feet_move_at_one_stroke_per_stance(name: str) -> None:
    gait = GAITS[name]
    stroke, period = 0.2, 2.0
    dt = period / STEPS
    phases, feet = walk(gait, forward=gait.speed(stroke=stroke, period=period) * dt)
    velocity = np.diff(feet, axis=0) / dt
    for k in range(1, STEPS):
        for leg, phase in enumerate(leg_phases(gait, phases[k])):
            if 1e-9 < phase <= gait.duty:
                np.testing.assert_allclose(velocity[k - 1, leg], [-stroke / (gait.duty * period), 0.0], atol=1e-12)


@pytest.mark.parametrize("name", GAITS)
def test_feet_span_the_stroke_about_their_nominal_place(name: str) -> None:
    gait = GAITS[name]
    _, feet = walk(gait, forward=0.2 / (gait.duty * STEPS))
    travel = feet[:, :, 0] - NOMINAL[:, 0]
    np.testing.assert_allclose(travel.max(axis=0), 0.1, atol=0.01)
    np.testing.assert_allclose(travel.min(axis=0), -0.1, atol=0.01)
    np.testing.assert_allclose(feet[:, :, 1], np.broadcast_to(NOMINAL[:, 1], (STEPS, 6)), atol=1e-12)


def test_turning_feet_circle_the_body() -> None:
    gait = GAITS["tripod"]
    turn = 0.2 / (gait.duty * STEPS)
    phases, feet = walk(gait, forward=0.0, turn=turn)
    for k in range(1, STEPS):
        for leg, phase in enumerate(leg_phases(gait, phases[k])):
            if 1e-9 < phase <= gait.duty:
                angle = np.arctan2(*feet[k, leg, ::-1]) - np.arctan2(*feet[k - 1, leg, ::-1])
                assert (angle + np.pi) % (2 * np.pi) - np.pi == pytest.approx(-turn, rel=1e-3)


@pytest.mark.parametrize("name", GAITS)
def test_feet_and_heights_are_continuous(name: str) -> None:
    gait = GAITS[name]
    _, feet = walk(gait, forward=0.2 / (gait.duty * STEPS))
    swing_steps = (1 - gait.duty) * STEPS
    assert np.abs(np.diff(feet, axis=0)).max() < 1.6 * 0.2 / swing_steps  # glide's greatest slope is 1.5
    up = np.array([gait.heights(phase).full().ravel() for phase in np.linspace(0, 1, 2001)])
    assert np.abs(np.diff(up, axis=0)).max() < 3.2 / (2000 * (1 - gait.duty))  # lift's greatest slope is 3.08
    assert up.min() == 0.0
    assert up.max() == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("profile", [glide, lift])
def test_swing_starts_and_ends_at_rest(profile: object) -> None:
    assert callable(profile)
    h = 1e-6
    assert (profile(h) - profile(0.0)) / h == pytest.approx(0.0, abs=1e-4)
    assert (profile(1.0) - profile(1.0 - h)) / h == pytest.approx(0.0, abs=1e-4)


def test_wave_is_statically_stable_at_every_phase() -> None:
    gait = GAITS["wave"]
    phases, feet = walk(gait, forward=0.2 / (gait.duty * STEPS))
    for phase, at in zip(phases, feet, strict=True):
        standing = [leg for leg, p in enumerate(leg_phases(gait, phase)) if p <= gait.duty]
        corners = sorted((at[leg] for leg in standing), key=lambda p: np.arctan2(p[1], p[0]))
        # Counter-clockwise about the origin: all cross products positive, so the origin is inside.
        margins = [a[0] * b[1] - a[1] * b[0] for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
        assert min(margins) > 0.0
