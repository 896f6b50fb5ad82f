"""The first picture of the live page, and the first minutes of a new user: from a bare machine to that picture."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from playwright.sync_api import Browser, Page

from benchmarks.measure import LOWER, Benchmark, interleaved_values, ratio, spread
from tests.chromium import running_browser
from vtbdrake.web import view
from vtbdrake_diagrams.space_climber import SpaceClimberScenario

ROOT = Path(__file__).resolve().parents[1]
GOAL = 90.0  # s, as long as one waits for something that one only wants to see
OUR_GOAL = 5.0  # s
PICTURE_GOAL = 1.2  # what our server and our panel may add to Meshcat's own page
# An element that the page has when it shows the state of the testbed.
_DRAWN = "body[data-session=open][data-frame]"

_PATIENCE = 120_000  # ms
# Notes when the scene has got its last mesh, and has been drawn.
_WATCH = """{
  const draw = window.requestAnimationFrame.bind(window);
  window.drawn = { meshes: 0, at: 0 };
  const count = () => {
    let meshes = 0;
    if (typeof viewer !== "undefined") viewer.scene.traverse((object) => (meshes += object.isMesh ? 1 : 0));
    if (meshes !== window.drawn.meshes) {
      const drawn = (window.drawn = { meshes, at: 0 });
      draw(() => draw(() => (drawn.at = Date.now())));
    }
    draw(count);
  };
  draw(count);
}
"""


def first_picture(repeats: int = 5) -> list[Benchmark]:
    """Time from a live page's address to the picture of its robot in Chromium, over the time of Meshcat's own page.

    Both show the same Meshcat, in turns, without anything in a cache. Our page exchanges its ticket for a session
    first, and has the panel beside the scene. Printed beside it: until the panel shows the session's state, too.
    """
    with view(SpaceClimberScenario()) as viewed, running_browser() as browser:
        meshes = _meshes(browser, viewed.session.meshcat_url)
        panels = []

        def bare() -> float:
            return _opened(browser, viewed.session.meshcat_url, meshes)[0]

        def ours() -> float:
            picture, panel = _opened(browser, viewed.url, meshes, until=_DRAWN)
            panels.append(panel)
            return picture

        ours_s, bare_s = interleaved_values(ours, bare, repeats=repeats)
    shown = np.array(panels[1:])
    note = f"{spread(ours_s)}, Meshcat's {spread(bare_s)}, Chromium with a software renderer"
    return [
        Benchmark(
            name="first_picture",
            value=ratio(ours_s, bare_s),
            unit="1",
            goal=PICTURE_GOAL,
            better=LOWER,
            against="Meshcat's own page of the same scene",
            note=note,
        ),
        Benchmark(
            name="first_picture_panel",
            value=ratio(shown, bare_s),
            unit="1",
            goal=None,
            better=LOWER,
            against="Meshcat's own page of the same scene",
            note=f"until the panel has values, too: {spread(shown)}",
        ),
    ]


@contextmanager
def _page(browser: Browser) -> Iterator[Page]:
    """Yield a page of a browser that has seen nothing yet."""
    with closing(browser.new_context(viewport={"width": 1280, "height": 800})) as nobody:
        page = nobody.new_page()
        page.add_init_script(_WATCH)
        yield page


def _meshes(browser: Browser, url: str) -> int:
    """Return the number of meshes of a scene, when no more come."""
    with _page(browser) as page:
        page.goto(url)
        page.wait_for_function("window.drawn.at && Date.now() - window.drawn.at > 1000", timeout=_PATIENCE)
        meshes: int = page.evaluate("window.drawn.meshes")
        return meshes


def _opened(browser: Browser, url: str, meshes: int, *, until: str = "body") -> tuple[float, float]:
    """Return the seconds until a page shows a scene with a number of meshes, and until it has an element, too."""
    with _page(browser) as page:
        begin = time.time()
        page.goto(url, wait_until="commit")
        page.wait_for_function(f"window.drawn.meshes === {meshes} && window.drawn.at", timeout=_PATIENCE)
        picture = page.evaluate("window.drawn.at") / 1e3
        page.wait_for_selector(until, state="attached", timeout=_PATIENCE)
        return picture - begin, max(picture, time.time()) - begin


def bare_to_browser() -> list[Benchmark]:
    """Seconds from an empty environment to the first picture of ``vtbdrake view cart_pole`` in Chromium.

    The wheel of this Python that `make dist` has made is installed, with the tested versions of what it depends on, by
    pip: from its cache or the registry, which is most of the time. Ours is the rest: pip's installation of the wheel
    alone, and the time from the command to the picture, which imports Drake. The split is printed: the environment,
    the download and the installation of what it depends on (by the times in pip's log), and both parts of ours.
    """
    python = "cp{}{}".format(*sys.version_info)
    wheels = sorted((ROOT / "dist").glob(f"*-{python}-*.whl"))
    if not wheels:
        raise FileNotFoundError(f"there is no wheel for {python} in dist/: run make dist first")
    constraints = ROOT / "constraints" / f"py{python.removeprefix('cp')}.txt"
    with TemporaryDirectory() as folder, running_browser() as browser:
        begin = time.perf_counter()
        environment, log = Path(folder) / "lab", Path(folder) / "pip.log"
        subprocess.run([sys.executable, "-m", "venv", environment], check=True)
        made = time.perf_counter()
        pip = [str(environment / "bin" / "python"), "-m", "pip", "--quiet", "--disable-pip-version-check", "install"]
        options = ["--log", str(log), "--constraint", str(constraints)]
        subprocess.run([*pip, *options, f"{wheels[-1]}[web]"], env=_variables(), check=True)
        installed = time.perf_counter()
        with _viewing(environment, folder) as url:
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            page.goto(url)
            page.wait_for_selector(_DRAWN, state="attached", timeout=120_000)
            page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
            shown = time.perf_counter()
            page.close()
        subprocess.run([*pip, "--no-deps", "--force-reinstall", str(wheels[-1])], env=_variables(), check=True)
        alone = time.perf_counter() - shown
        unpacking = installation_time(log.read_text("utf-8"))
    ours = alone + shown - installed
    note = f"environment {made - begin:.1f} s; dependencies: download {installed - made - unpacking:.1f} s, "
    note += f"installation {max(unpacking - alone, 0.0):.1f} s; ours: the wheel alone {alone:.1f} s, "
    note += f"command to picture {shown - installed:.1f} s"
    against = "nothing: pip's cache or the registry, and the machine"
    rows = (("bare_to_browser", shown - begin, GOAL, note), ("bare_to_browser_ours", ours, OUR_GOAL, ""))
    return [
        Benchmark(
            name=name,
            value=value,
            unit="s",
            goal=goal,
            better=LOWER,
            absolute="what a person waits for",
            against=against,
            note=text,
        )
        for name, value, goal, text in rows
    ]


def installation_time(log: str) -> float:
    """Return the seconds between "Installing collected packages" and the last line of a log of pip.

    Raises:
        ValueError: The log has no such line: nothing was installed, or pip writes other logs now.
    """
    stamps = [datetime.fromisoformat(stamp) for stamp in re.findall(r"^(\d{4}-\d\d-\d\dT\S+) ", log, re.MULTILINE)]
    begin = re.search(r"^(\S+) Installing collected packages", log, re.MULTILINE)
    if begin is None:
        raise ValueError("the log of pip does not say when it began to install")
    return (stamps[-1] - datetime.fromisoformat(begin[1])).total_seconds()


def _variables() -> dict[str, str]:
    """Return the environment variables of a new user: nothing of this checkout is found."""
    return {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}


@contextmanager
def _viewing(environment: Path, folder: str) -> Iterator[str]:
    """Yield the address of the page of ``vtbdrake view cart_pole``, which runs in an environment of its own."""
    command = [str(environment / "bin" / "vtbdrake"), "view", "cart_pole", "--no-browser", "--play"]
    with subprocess.Popen(command, cwd=folder, env=_variables(), stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield next(match[0] for line in process.stdout if (match := re.search(r"https?://\S+", line)))
        finally:
            process.terminate()
