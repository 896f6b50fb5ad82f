"""This benchmark measures the first minutes of a new user: from a bare machine to the moving robot in the browser."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.measure import LOWER, Benchmark
from tests.chromium import running_browser

ROOT = Path(__file__).resolve().parents[1]
GOAL = 90.0  # s, as long as one waits for something that one only wants to see
OUR_GOAL = 5.0  # s
# An element that the page has when it shows the state of the testbed.
_DRAWN = "body[data-session=open][data-frame]"


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
    ours = alone + shown - installed
    unpacking = installation_time(log.read_text("utf-8"))
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
