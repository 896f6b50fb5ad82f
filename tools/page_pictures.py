"""Take the pictures of the pages in a browser: docs/study_page.png.

python tools/page_pictures.py
"""

from __future__ import annotations

import io
import tempfile
from pathlib import Path

from PIL import Image

import vtbdrake as vtb
from tests.chromium import running_browser
from vtbdrake.rollout.named_function import largest
from vtbdrake_diagrams.space_climber import SpaceClimberScenario

FOLDER = Path(__file__).resolve().parents[1] / "docs"
SIZE = {"width": 1280, "height": 800}


def study_page() -> Image.Image:
    """Return a picture of the page of a study of the climber's gait, with a ghost."""
    problem = vtb.Problem(
        scenario=SpaceClimberScenario(),
        parameters=[
            vtb.Parameter("dps.impl.gait.period", 0.5, 2.0),
            vtb.Parameter("dps.impl.gait.stroke", 0.02, 0.2),
            vtb.Parameter("dps.impl.gait.ramp_time", 0.1, 2.0),
        ],
        quality=vtb.Quality(largest, "sim.sys.climber.base.x", reading="end"),
        constraints=[vtb.Constraint(largest, "sim.sys.climber.base.pitch", at_most=0.05)],
        horizon=4.0,
    )
    with tempfile.TemporaryDirectory() as folder, problem.study(Path(folder) / "gait.db", solver="bayesian") as study:
        study.run(rollouts=40, progress=False)
        with study.view() as view, running_browser() as browser:
            page = browser.new_page(viewport=SIZE)
            page.goto(view.url)
            page.wait_for_selector("body[data-best][data-model]", state="attached", timeout=120_000)
            page.evaluate("vtb.rollouts.point({ trial: 3 })")
            page.wait_for_selector("body[data-pointed='3']", state="attached", timeout=120_000)
            page.evaluate("vtb.playback.setTime(2.0)")
            page.wait_for_selector("body[data-time='2']", state="attached", timeout=120_000)
            page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
            return Image.open(io.BytesIO(page.screenshot()))


if __name__ == "__main__":
    picture = study_page().convert("RGB").resize((960, 600), Image.Resampling.LANCZOS)
    # Small colours, such as marks, have their place in the palette, too; shades between its colours are dithered.
    palette = picture.quantize(256, Image.Quantize.MAXCOVERAGE)
    picture.quantize(palette=palette).save(FOLDER / "study_page.png", optimize=True)
