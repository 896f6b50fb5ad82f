"""The page of a study at a glance, in a real browser: colours, symbols, slices, importances, and all trials."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from tests.axe import axe, serious_violations
from tests.chromium import PHONE, WIDE, needs_chromium, opened_page, screenshot
from tests.web.live.test_page import drawn
from tests.web.study.studies import ANGLE, PLACE, RATE, cart_pole_problem
from vtbdrake.optimization import Choice, Parameter, Study
from vtbdrake.optimization.importance import importances
from vtbdrake.rollout import Quality
from vtbdrake.rollout.named_function import magnitude
from vtbdrake.web import StudyView, view_study

__all__ = ["axe"]

READY = "body[data-session=open][data-trials]"
PARAMETERS = (
    Parameter(ANGLE, 0.5, 3.0),
    Parameter(RATE, -3.0, 3.0),
    Parameter("sim.sys.cart_pole.pole.mass", 0.1, 1.0, log=True),
    Parameter("sim.sys.cart_pole.cart.mass", 5.0, 20.0),
    Choice(PLACE, [-0.5, 0.0, 0.5]),
)

pytestmark = [pytest.mark.slow, pytest.mark.one_python, needs_chromium]


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    """Five parameters and two qualities of one function, with one point more than the study was asked for."""
    problem = cart_pole_problem(
        parameters=PARAMETERS,
        quality=[Quality(magnitude, PLACE, unit="m"), Quality(magnitude, RATE, minimize=True, unit="rad/s")],
        horizon=0.25,
    )
    study = problem.study(tmp_path_factory.mktemp("overview") / "cart.db", solver="random", seed=3)
    study.run(rollouts=60, executor="serial", progress=False)
    point = [2.0, 1.0, 0.3, 9.0, 0.5]
    study.add_results(point, [problem.rollout(point)])
    return study


@pytest.fixture(scope="module")
def opened(study: Study) -> Iterator[StudyView]:
    assert study.path is not None
    with view_study(study.path) as view:
        yield view


@pytest.fixture(scope="module")
def shared(browser: Browser, opened: StudyView) -> Iterator[Page]:
    with opened_page(browser, opened.url, ready=READY, size=(WIDE["width"], WIDE["height"])) as page:
        drawn(page, "document.body.dataset.rollouts === '61'")
        yield page


@pytest.fixture
def page(shared: Page) -> Page:
    """The page as it begins, whatever was done there."""
    shared.set_viewport_size(WIDE)
    shared.emulate_media(color_scheme="light")
    shared.evaluate("""() => {
      document.body.classList.remove("vtb-folded");
      document.querySelector("#vtb-study").scrollTo(0, 0);
      vtb.charts.choose("landscape");
      vtb.openTab("trials");
    }""")
    return shared


def column(page: Page, number: int) -> list[str]:
    """The texts of a column of the table."""
    return page.locator(f"#vtb-trials tbody tr > :nth-child({number + 1})").all_inner_texts()


def test_what_the_study_has_done_is_counted(page: Page) -> None:
    assert page.inner_text("[data-fact=rollouts]").endswith("61 (60 asked for)")
    assert page.inner_text("[data-fact=waiting]").endswith("1 point")


def test_colours_and_symbols_are_explained(page: Page, study: Study) -> None:
    bar = page.inner_text("#vtb-colors").splitlines()
    assert bar[0] == "magnitude of position [m], maximize ↑: brighter is better, by rank"
    values = sorted(trial.values[0] for trial in study.trials)
    assert [float(text) for text in bar[1:]] == pytest.approx([values[k] for k in (0, 15, 30, 44, 59)], rel=5e-3)
    page.select_option("#vtb-quality", label="magnitude of velocity [rad/s], minimize ↓")
    worst, *_, best = (float(text) for text in page.inner_text("#vtb-colors").splitlines()[1:])
    assert worst > best
    page.select_option("#vtb-quality", "0")
    legend = page.locator("#vtb-legend li").all_inner_texts()
    kinds = {trial.kind for trial in study.trials}
    assert ("breaks a constraint" in legend) == ("broken" in kinds) and "failed" not in legend
    best_of_front = max(study.pareto(), key=lambda trial: trial.values[0])
    assert f"front's best magnitude of position, trial {best_of_front.number}" in legend


def test_table_of_trials_sorts_and_filters_within_its_width(page: Page, study: Study) -> None:
    trials = sorted(study.trials, key=lambda trial: -trial.values[0])
    assert column(page, 0) == [str(trial.number) for trial in trials[:50]]
    overflow = "(() => { const { scrollWidth, clientWidth } = document.querySelector('.vtb-scroll'); "
    assert page.evaluate(f"{overflow} return scrollWidth - clientWidth; }})()") <= 0
    page.click("#vtb-later")
    assert column(page, 0) == [str(trial.number) for trial in trials[50:]]
    heads = page.locator("#vtb-trials thead th button")
    heads.nth(6).click()  # the mass of the pole, from the smallest
    by_mass = sorted(study.trials, key=lambda trial: trial.point[2])
    assert column(page, 0) == [str(trial.number) for trial in by_mass[:50]]
    assert page.get_attribute("#vtb-trials thead th:nth-child(5)", "aria-sort") == "none"
    filters = page.locator(".vtb-filters input")
    filters.nth(3).fill("1..2")  # the angle
    filters.nth(7).fill("0.5")  # the place; -0.5 has these letters, too
    chosen = [t for t in by_mass if 1.0 <= t.point[0] <= 2.0 and t.point[4] in (-0.5, 0.5)]
    assert 0 < len(chosen) < 50 and column(page, 0) == [str(trial.number) for trial in chosen]
    assert page.inner_text(".vtb-pager output").endswith(f"of {len(chosen)} (60 in all) trials")
    with page.expect_download() as download:
        page.click("#vtb-csv")
    head, *rows = csv.reader(Path(download.value.path()).read_text(encoding="utf-8").splitlines())
    assert head[:2] == ["trial", "end"] and head[4] == f"{ANGLE} [rad]"
    assert [[float(text) for text in row[2:]] for row in rows] == [[*t.values, *t.point] for t in chosen]
    filters.nth(3).fill("about 1")
    assert filters.nth(3).get_attribute("aria-invalid") == "true"
    for number in (3, 7):
        filters.nth(number).fill("")
    page.select_option(".vtb-filters select", "front")
    assert set(column(page, 0)) == {str(trial.number) for trial in study.pareto()}
    page.select_option(".vtb-filters select", "")
    heads.nth(2).click()


def test_importances_and_slices_of_every_parameter(page: Page, study: Study) -> None:
    page.click("#vtb-view-importance")
    page.wait_for_selector("#vtb-importance i")
    shares = importances(study)[0]
    assert page.locator("#vtb-importance th").evaluate_all("heads => heads.map(({ title }) => title)") == list(shares)
    texts = page.locator("#vtb-importance td:last-child").all_inner_texts()
    assert texts == [f"{100 * share:.1f} %" for share in shares.values()]
    page.click("#vtb-view-slices")
    drawn(
        page, "[...document.querySelectorAll('#vtb-slices canvas')].filter(c => c.dataset.points === '60').length === 5"
    )
    assert page.inner_text("#vtb-colors").splitlines()[0] == "order of the trials"
    x = page.evaluate("vtb.charts.slices.charts.map((chart) => chart.data.x[7])")
    assert x[:4] == list(study.trials[7].point[:4])


def test_button_that_cannot_says_why(page: Page) -> None:
    assert page.is_disabled("#vtb-stop") and page.is_disabled("#vtb-run")
    page.click("#vtb-stop", force=True)
    page.wait_for_selector("#vtb-messages >> text=no process runs the study")
    page.focus("#vtb-run")
    page.keyboard.press("Enter")
    page.wait_for_selector("#vtb-messages >> text=all 60 rollouts that were asked for are done")


def test_keys_walk_through_the_trials_and_keep_one(page: Page, study: Study) -> None:
    order = sorted(study.trials, key=lambda trial: trial.point[0])
    page.focus("#vtb-landscape")
    for _ in range(3):
        page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowLeft")
    assert page.inner_text("#vtb-pointed").startswith(f"trial {order[1].number}")
    page.keyboard.press("Enter")
    assert page.evaluate("vtb.rollouts.shown") == order[1].number
    page.keyboard.press("Escape")
    assert page.inner_text("#vtb-pointed") == ""
    page.evaluate("vtb.rollouts.pin(vtb.trials.best)")


def test_tab_reaches_all_that_can_be_used(page: Page) -> None:
    page.click("#vtb-tab-search")
    usable = "#vtb-head button, #vtb-study :is(button, input, select, canvas[tabindex]), #vtb-bar :is(button, input)"
    wanted = page.evaluate(
        f"""() => [...document.querySelectorAll("{usable}")].filter((e) => e.checkVisibility()).length"""
    )
    page.evaluate("document.activeElement.blur()")
    page.evaluate("window.reached = new Set()")
    page.evaluate("document.addEventListener('focusin', ({ target }) => window.reached.add(target))")
    for _ in range(wanted + 10):
        page.keyboard.press("Tab")
    missed = page.evaluate(f"""() => [...document.querySelectorAll("{usable}")]
      .filter((e) => e.checkVisibility() && !window.reached.has(e)).map((e) => e.outerHTML)""")
    assert wanted > 25 and missed == []


def test_phone_reaches_everything_and_folds_the_panel(page: Page) -> None:
    page.set_viewport_size(PHONE)
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    beside = """() => [...document.querySelectorAll("#vtb-head button, #vtb-study :is(button, select), #vtb-bar *")]
      .filter((e) => e.checkVisibility() && !e.closest(".vtb-scroll"))
      .filter((e) => e.getBoundingClientRect().left < 0 || e.getBoundingClientRect().right > innerWidth)
      .map((e) => e.outerHTML)"""
    for tab in ("trials", "try", "search", "changes", "failures"):
        page.click(f"#vtb-tab-{tab}")
        assert page.evaluate(beside) == []
    before = page.locator("#meshcat-pane").bounding_box()
    page.click("#vtb-fold")
    after = page.locator("#meshcat-pane").bounding_box()
    assert before is not None and after is not None and after["height"] > 1.8 * before["height"]
    assert not page.is_visible("#vtb-study") and page.get_attribute("#vtb-fold", "aria-expanded") == "false"
    page.click("#vtb-fold")
    assert page.is_visible("#vtb-study")


def test_charts_are_dark_in_the_dark(page: Page) -> None:
    def brightness() -> float:
        drawn(page, "vtb.charts.history.draws > 0")
        page.locator("#vtb-history-chart").scroll_into_view_if_needed()
        box = page.locator("#vtb-history-chart").bounding_box()
        assert box is not None
        return float(np.median(screenshot(page, clip=box)))

    assert brightness() > 240.0
    page.emulate_media(color_scheme="dark")
    assert brightness() < 60.0


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_no_serious_violation(page: Page, axe: str, scheme: str) -> None:
    page.emulate_media(color_scheme=scheme)
    for name in ("try", "search", "changes", "failures", "trials"):
        page.click(f"#vtb-tab-{name}")
        assert serious_violations(page, axe) == []
    for name in ("slices", "importance", "pareto"):
        page.click(f"#vtb-view-{name}")
        assert serious_violations(page, axe) == []


def test_one_parameter_and_three_trials_have_values_and_no_landscape(browser: Browser) -> None:
    study = cart_pole_problem(parameters=[Parameter(ANGLE, 0.5, 3.0)], horizon=0.1).study(solver="random", seed=1)
    study.run(rollouts=3, executor="serial", progress=False)
    with study.view() as view, opened_page(browser, view.url, ready=READY) as page:
        assert page.locator("nav[aria-label=charts] button").all_inner_texts() == ["values"]
        assert len(page.locator("#vtb-colors .vtb-bar-ticks span").all()) == 3
        assert page.inner_text(".vtb-pager output") == "1 to 3 of 3 trials"
