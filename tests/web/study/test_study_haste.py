"""Nothing that somebody does on the page of a study is lost, and the page finds its server again."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page

from tests.chromium import WIDE, needs_chromium, opened_page
from tests.web.live.test_page_panel import CUT, KEEP_SOCKETS
from tests.web.study.studies import ANGLE, PLACE, cart_pole_problem
from vtbdrake.optimization import Choice, Parameter
from vtbdrake.web import StudyView, view_study

READY = "body[data-session=open][data-trials='8'][data-rollouts='8']"

pytestmark = [pytest.mark.slow, pytest.mark.one_python, needs_chromium]


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    parameters = [Parameter(ANGLE, 0.5, 3.0), Choice(PLACE, [-0.5, 0.0, 0.25, 0.5])]
    problem = cart_pole_problem(parameters=parameters, constraints=[], horizon=0.25)
    path = tmp_path_factory.mktemp("haste") / "cart.db"
    with problem.study(path, solver="random", seed=3) as study:
        study.run(rollouts=8, executor="serial", progress=False)
    return path


@pytest.fixture(scope="module")
def opened(path: Path) -> Iterator[StudyView]:
    with view_study(path) as view:
        yield view


@pytest.fixture(scope="module")
def page(browser: Browser, opened: StudyView) -> Iterator[Page]:
    size = (WIDE["width"], WIDE["height"])
    with opened_page(browser, opened.url, ready=READY, size=size, script=KEEP_SOCKETS) as page:
        yield page


def test_row_that_is_renewed_while_it_is_pressed_is_chosen(page: Page) -> None:
    trial, x, y = page.evaluate("""() => {  // In one step: the table may be renewed between two.
      const row = document.querySelectorAll("#vtb-trials tbody tr")[3];
      row.scrollIntoView({ block: "center", behavior: "instant" });
      const box = row.getBoundingClientRect();
      return [row.dataset.trial, box.x + 0.7 * box.width, box.y + 0.5 * box.height];
    }""")
    page.mouse.move(x, y)
    page.mouse.down()
    page.evaluate("vtb.table.show()")
    page.mouse.up()
    page.wait_for_function(f"vtb.rollouts.pinned && vtb.rollouts.shown === {trial}")
    page.wait_for_selector(f"tr.chosen[data-trial='{trial}']")  # The rows are renewed all the same.


def test_status_from_before_a_change_does_not_take_it_back(page: Page, opened: StudyView) -> None:
    page.click("#vtb-tab-search")
    boxes = page.locator(f"[data-address='{PLACE}'] .vtb-options input")
    page.evaluate("""() => {
      const before = structuredClone(vtb.status);
      const options = document.querySelectorAll(".vtb-options input");
      for (const option of [0, 3]) {
        options[option].click();
        vtb.interventions.show(before);
      }
    }""")
    page.wait_for_function("document.body.dataset.interventions === '2'")
    (chosen,) = [dimension for dimension in opened.study.search.ranges if dimension.address == PLACE]
    assert isinstance(chosen, Choice) and list(chosen.options) == [0.0, 0.25]
    boxes.nth(1).click()  # It is refused: a choice has two options at least.
    page.wait_for_function("vtb.messages.querySelector('.bad')")
    page.wait_for_function(
        "[...document.querySelectorAll('.vtb-options input')].map((box) => +box.checked) + '' === '0,1,1,0'"
    )


def test_text_is_kept_while_a_better_trial_comes(page: Page) -> None:
    page.click("#vtb-tab-try")
    text = page.locator("#vtb-try input[type=text] >> nth=0")
    text.fill("2.5")
    page.evaluate("vtb.attempts.setDraft(vtb.trials.point(0), { followsBest: true })")
    page.keyboard.press("Tab")
    page.wait_for_function("vtb.attempts.draft[0] === 2.5")


def test_lost_connection_comes_back_and_a_server_that_is_gone_is_told(
    page: Page, opened: StudyView, path: Path
) -> None:
    port = int(opened.url.split(":")[2].split("/")[0])
    page.route("**/", lambda route: route.abort())
    page.evaluate("window.isOld = true")
    page.evaluate(CUT)
    page.wait_for_selector("body[data-session=lost]", state="attached")
    assert page.evaluate("vtb.main.inert && vtb.head.inert && vtb.playback.bar.inert")
    page.wait_for_function("vtb.messages.textContent.includes('the connection is lost')")
    page.unroute("**/")
    page.wait_for_function("!window.isOld && window.vtb?.trials.count === 8")
    opened.close()
    with view_study(path, port=port):
        page.wait_for_function("vtb.messages.textContent.includes('open the address that it has printed')")
