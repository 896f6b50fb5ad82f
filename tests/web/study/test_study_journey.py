"""The page of a study in a real browser: what is in its pictures, and what a person can do there."""

from __future__ import annotations

import signal
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from tests.chromium import needs_chromium, opened_page, screenshot, until
from tests.web.live.test_page import GREEN, drawn, share
from tests.web.study.studies import ANGLE, FORCE, PLACE, RATE, cart_pole_problem, drive_cart, run_elsewhere
from vtbdrake.optimization import Parameter, Study
from vtbdrake.rollout import Quality
from vtbdrake.rollout.named_function import magnitude
from vtbdrake.web import SimulationSession, StudyView, view_study

PURPLE = np.array([204, 51, 153])  # the ghost of the point at the pointer

pytestmark = [pytest.mark.slow, pytest.mark.one_python, needs_chromium]


def page_of(browser: Browser, view: StudyView) -> AbstractContextManager[Page]:
    return opened_page(browser, view.url, ready="body[data-session=open][data-trials]", size=(1000, 700))


def scene(page: Page, shows: Callable[[np.ndarray], bool]) -> np.ndarray:
    """The rollouts, between head and bar, when they show something, shape (height, width, 3)."""
    return until(lambda: screenshot(page, clip={"x": 505, "y": 120, "width": 490, "height": 520}), shows)


def has_ghost(image: np.ndarray) -> bool:
    """Whether a picture shows the ghost of the point at the pointer."""
    return share(image, PURPLE) > 0.005


def is_drawn(image: np.ndarray) -> bool:
    """Whether a picture has the shades of a robot, and not of an empty canvas only."""
    return len(np.unique(image.reshape(-1, 3), axis=0)) > 100


def place_of(page: Page, chart: str, trial: int) -> tuple[float, float]:
    """Where a trial lies on the screen."""
    drawn(page, f"vtb.charts.{chart}.draws > 0 && vtb.charts.{chart}.data.x.length > {trial}")
    return _on_screen(page, chart, f"vtb.charts.{chart}.data.x[{trial}]", f"vtb.charts.{chart}.data.y[{trial}]")


def place_of_drive(page: Page, chart: str, number: int) -> tuple[float, float]:
    """Where the mark of a driven trial lies on the screen."""
    mark = f"vtb.charts.{chart}.data?.marks?.find(({{ pick }}) => pick?.drive === {number})?.at"
    drawn(page, mark)
    return _on_screen(page, chart, f"{mark}[0]", f"{mark}[1]")


def _on_screen(page: Page, chart: str, x_of_data: str, y_of_data: str) -> tuple[float, float]:
    """Return where a point of a chart lies on the screen, from expressions for its values."""
    x, y = page.evaluate(f"[vtb.charts.{chart}.x({x_of_data}), vtb.charts.{chart}.y({y_of_data})]")
    box = page.locator(f"#{page.evaluate(f'vtb.charts.{chart}.canvas.id')}").bounding_box()
    assert box is not None
    return box["x"] + x, box["y"] + y


def test_landscape_can_be_entered(browser: Browser, tmp_path: Path) -> None:
    problem = cart_pole_problem()
    with problem.study(tmp_path / "a.db", solver="sobol", seed=2) as study:
        study.run(rollouts=16, executor="serial", progress=False)
        best, trials = study.best, study.trials
    drive = drive_cart(tmp_path / "a.db")
    far = max(range(16), key=lambda k: abs(trials[k].point[0] - best.point[0]))
    with view_study(tmp_path / "a.db") as view, page_of(browser, view) as page:
        assert page.title() == "a.db: study"
        drawn(page, f"document.body.dataset.best === '{best.number}' && document.body.dataset.model === '16'")
        assert page.inner_text("[data-fact=best]").endswith(f"{best.value:.5g} m")
        landscape = screenshot(page, clip={"x": 90, "y": 150, "width": 380, "height": 240})
        assert len(np.unique(landscape.reshape(-1, 3), axis=0)) > 50  # the model's shades
        before = scene(page, is_drawn)
        assert is_drawn(before) and share(before, PURPLE) < 1e-3
        # The pointer at a trial shows its ghost, at the slider's time.
        page.mouse.move(*place_of(page, "landscape", far))
        drawn(page, f"document.body.dataset.pointed === '{far}'")
        assert f"trial {far}: magnitude = {trials[far].value:.5g}" in page.inner_text("#vtb-pointed")
        pointed = scene(page, has_ghost)
        assert has_ghost(pointed)
        page.evaluate("vtb.playback.setTime(0.6)")
        drawn(page, "document.body.dataset.time === '0.6'")

        def has_moved(image: np.ndarray) -> bool:
            return has_ghost(image) and float(np.mean(np.abs(image - pointed).max(axis=2) > 30)) > 0.005

        assert has_moved(scene(page, has_moved))
        page.mouse.move(5, 5)
        page.wait_for_selector("#vtb-key-pointed", state="hidden")
        # What was driven by hand has marks of its own, which show it.
        for chart in ("landscape", "history"):
            page.mouse.move(*place_of_drive(page, chart, drive.number))
            drawn(page, f"document.body.dataset.pointed === 'drive {drive.number}'")
            assert f"driven by Ada: magnitude = {drive.outcome.value:.5g}" in page.inner_text("#vtb-pointed")
            assert has_ghost(scene(page, has_ghost))
            page.mouse.move(5, 5)
            page.wait_for_selector("#vtb-key-pointed", state="hidden")
        # A click tries a point.
        page.click("#vtb-tab-try")
        page.check("#vtb-try-click")
        box = page.locator("#vtb-landscape").bounding_box()
        assert box is not None
        page.mouse.click(box["x"] + 0.6 * box["width"], box["y"] + 0.4 * box["height"])
        drawn(page, "document.body.dataset.tried === '1'")
        value = problem.rollout(page.evaluate("vtb.attempts.tried.point")).value
        assert f"magnitude = {value:.5g}" in page.inner_text("#vtb-tried")
        assert share(before, GREEN) < 5e-4 < share(scene(page, lambda image: share(image, GREEN) > 5e-4), GREEN)
        page.click("#vtb-add")
        page.wait_for_selector("[data-fact=waiting]")


def test_running_study_is_watched_until_its_process_dies(browser: Browser, tmp_path: Path) -> None:
    path = tmp_path / "a.db"
    cart_pole_problem().study(path, solver="CMA-ES").close()
    with view_study(path) as view, page_of(browser, view) as page:
        assert page.inner_text("[data-fact=state]").endswith("not begun")
        runner = run_elsewhere(path, rollouts=5000)
        drawn(page, "document.body.dataset.state === 'running' && Number(document.body.dataset.trials) > 20")
        drawn(page, f"Number(document.body.dataset.trials) > {page.evaluate('vtb.trials.count')}")
        assert " of 5000" in page.inner_text("[data-fact=rollouts]")
        runner.send_signal(signal.SIGKILL)
        runner.wait()
        page.wait_for_selector("#vtb-resume")
        assert "its process has died" in page.inner_text("[data-fact=state]")
        assert "study continue" in page.inner_text("[data-kind=died]")


def test_study_is_steered_on_its_page(browser: Browser, tmp_path: Path) -> None:
    path = tmp_path / "a.db"
    with cart_pole_problem().study(path, solver="random", seed=4) as study:
        study.run(rollouts=8, executor="serial", progress=False)
    with view_study(path) as view, page_of(browser, view) as page:
        assert page.is_disabled("#vtb-stop") and page.is_disabled("#vtb-run")
        page.click("#vtb-tab-search")
        page.fill("#vtb-budget", "60")
        page.keyboard.press("Enter")
        drawn(page, "document.body.dataset.interventions === '1'")
        # A drag in the landscape forbids the left half.
        page.check("#vtb-forbid")
        page.locator("#vtb-landscape").scroll_into_view_if_needed()
        box = page.locator("#vtb-landscape").bounding_box()
        assert box is not None
        page.mouse.move(box["x"] + 63, box["y"] + 12)
        page.mouse.down()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] - 34, steps=3)
        page.mouse.up()
        drawn(page, "vtb.status.forbidden.length === 1")
        page.fill(f"[data-address='{RATE}'] input[aria-label$=lower]", "-1")
        page.keyboard.press("Enter")
        drawn(page, "document.body.dataset.interventions === '3'")
        page.fill(f"[data-address='{RATE}'] input[aria-label$=lower]", "7")
        page.keyboard.press("Enter")
        page.wait_for_selector("#vtb-messages >> text=lower < upper")
        page.click("#vtb-tab-changes")
        assert page.locator("#vtb-changes tr").count() == 3
        page.click("#vtb-run")
        drawn(page, "document.body.dataset.state === 'ended' && document.body.dataset.rollouts === '60'")
        drawn(page, "document.body.dataset.effective === '3' && document.body.dataset.trials === '60'")
        ((_, region),) = page.evaluate("vtb.status.forbidden")
        assert view.runner is not None and view.runner.wait() == 0
    with Study.open(path) as study:
        later = study.trials[8:]
        assert study.search.budget == 60
    assert len(later) == 52 and region[ANGLE][0] < 0.6 < 1.5 < region[ANGLE][1] < 1.9
    assert all(t.parameters[RATE] >= -1.0 for t in later)
    inside = [t for t in later if t.parameters[ANGLE] < region[ANGLE][1] and t.parameters[RATE] > region[RATE][0]]
    assert all(t.parameters[RATE] > region[RATE][1] or t.parameters[ANGLE] < region[ANGLE][0] for t in inside)


def test_pareto_front_and_parallel_axes(browser: Browser) -> None:
    problem = cart_pole_problem(
        parameters=[Parameter(ANGLE, 0.5, 3.0), Parameter("sim.sys.cart_pole.pole.mass", 0.1, 1.0, log=True),
                    Parameter("sim.sys.cart_pole.cart.mass", 5.0, 20.0)],
        quality=[Quality(magnitude, PLACE), Quality(magnitude, ANGLE, minimize=True)],
        constraints=[],
    )  # fmt: skip
    study = problem.study(solver="random", seed=1)
    study.run(rollouts=30, executor="serial", progress=False)
    study.intervene("budget", rollouts=60)
    with SimulationSession(problem.scenario, problem=problem) as session:
        session.drive([FORCE])
        session.advance(8)
        driven = session.end_drive()
    drive = study.add_driven(driven.course, driven.result, parameters=problem.values_in(driven.course.start), by="Ada")
    with study.view() as view, page_of(browser, view) as page:
        page.click("#vtb-view-pareto")
        assert set(page.evaluate("vtb.trials.front")) == {trial.number for trial in study.pareto()}
        end = page.evaluate("vtb.trials.front[0]")
        page.mouse.move(*place_of(page, "pareto", end))
        drawn(page, f"document.body.dataset.pointed === '{end}'")
        box = page.locator("#vtb-pareto").bounding_box()
        assert box is not None
        page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
        page.mouse.down()
        page.mouse.move(box["x"] + 0.7 * box["width"], box["y"] + 0.7 * box["height"], steps=3)
        page.mouse.up()
        drawn(page, "vtb.status.aspiration !== null")
        aspiration = study.search.aspiration
        assert aspiration is not None and list(aspiration) == page.evaluate("vtb.status.aspiration")
        page.click("#vtb-view-parallel")
        picture = screenshot(page, clip={"x": 20, "y": 130, "width": 460, "height": 250})
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50
        # The driven trial crosses the axis of the pole's mass at its default.
        drawn(page, "document.querySelector('#vtb-parallel').dataset.points === '30'")
        mass = drive.parameters["sim.sys.cart_pole.pole.mass"]
        x, y = page.evaluate(f"[vtb.charts.parallel.x(1), vtb.charts.parallel.y(1, {mass})]")
        box = page.locator("#vtb-parallel").bounding_box()
        assert box is not None
        page.mouse.move(box["x"] + x, box["y"] + y)
        drawn(page, f"document.body.dataset.pointed === 'drive {drive.number}'")
        assert "driven by Ada" in page.inner_text("#vtb-pointed")
