"""Take the moving picture of README.md, docs/view.webp, and make its four small pictures, in docs/uses/.

The moving picture shows a robot on the live page, a preview as a ghost, and how time goes back.

python tools/readme_picture.py          takes minutes without a graphics card
python tools/readme_picture.py small    only the small pictures, from other pages' pictures
"""

from __future__ import annotations

import io
import sys
from pathlib import Path

from PIL import Image, ImageOps
from playwright.sync_api import Page

from tests.chromium import PATIENCE, new_page, running_browser
from vtbdrake.web import view
from vtbdrake_diagrams.manipulator import ManipulatorScenario

DOCS = Path(__file__).resolve().parents[1] / "docs"
FILE = DOCS / "view.webp"
# The four uses, each with a picture of another page and the part of its width that is shown.
USES = {
    "develop": ("gallery/manipulator.png", 0.0, 1.0),
    "optimize": ("payload.png", 0.0, 0.5),
    "reason": ("headings.png", 0.5, 1.0),
    "control": ("controller.png", 0.515, 1.0),
}
# Pixels of a small picture.
SMALL = (220, 150)
# Pixels of the page, and of the picture.
PAGE = (1120, 640)
PICTURE = (840, 480)
# Milliseconds that a picture, and a picture at which something begins, is shown.
SHORT = 160
LONG = 900
# Steps of the simulation between two pictures.
STRIDE = 0.12  # s

JOINT = "sim.sys.arm.joint_4.position"


class Film:
    """Pictures of a page, each with the time in ms for which it is shown."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.pictures: list[Image.Image] = []
        self.durations: list[int] = []

    def take(self, duration: int = SHORT) -> None:
        """Add a picture of what the page shows when all that has been sent to it is drawn."""
        frames = int(self.page.evaluate("vtb.frames"))
        self.page.wait_for_function(f"vtb.frames >= {frames + 3}")
        self.page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        picture = Image.open(io.BytesIO(self.page.screenshot(timeout=PATIENCE))).convert("RGB")
        self.pictures.append(picture.resize(PICTURE, Image.Resampling.LANCZOS))
        self.durations.append(duration)

    def save(self, file: Path) -> None:
        """Write the pictures as an endless WebP."""
        first, *rest = self.pictures
        options = {"loop": 0, "quality": 60, "method": 6, "minimize_size": True}
        first.save(file, save_all=True, append_images=rest, duration=self.durations, **options)


def make_small_pictures() -> None:
    """Write a small picture of each use, on a white ground."""
    (DOCS / "uses").mkdir(exist_ok=True)
    for use, (source, begin, end) in USES.items():
        with Image.open(DOCS / source) as original:
            left, right = (round(edge * original.width) for edge in (begin, end))
            part = original.convert("RGB").crop((left, 0, right, original.height))
        picture = ImageOps.pad(part, SMALL, Image.Resampling.LANCZOS, color="white")
        picture.quantize(96).save(DOCS / "uses" / f"{use}.png", optimize=True)


def take_moving_picture() -> None:
    """Watch the arm move, try another angle of its elbow as a ghost, commit it, and go back to where it was."""
    with view(ManipulatorScenario(), values={"u.motion": 2.0}) as running, running_browser() as browser:
        session = running.session
        page = new_page(browser, size=PAGE)
        page.goto(running.url)
        page.wait_for_function("window.vtb && vtb.frames > 3")
        page.wait_for_function(f"vtb.watched.get('{JOINT}').values.length > 0")
        film = Film(page)
        film.take(LONG)

        def run(pictures: int) -> None:
            for _ in range(pictures):
                session.advance(round(STRIDE / session.config.step))
                film.take()

        run(10)
        slider = page.locator(f".vtb-watched[data-address='{JOINT}'] input[type=range]")
        low, high, now = (float(slider.evaluate(f"s => s.{name}")) for name in ("min", "max", "value"))
        box = slider.bounding_box()
        assert box is not None
        y = box["y"] + box["height"] / 2

        def place(value: float) -> float:
            return box["x"] + 8 + (value - low) / (high - low) * (box["width"] - 16)

        page.mouse.move(place(now), y)
        page.mouse.down()
        for part in range(1, 6):
            page.mouse.move(place(now + 0.16 * part), y)
            page.wait_for_selector("[data-kind=preview]", state="attached")
            film.take(2 * SHORT)
        film.durations[-1] = LONG
        page.mouse.up()
        page.wait_for_selector("[data-kind=preview]", state="detached")
        run(8)
        box = page.locator("#vtb-history").bounding_box()
        assert box is not None
        for share in (0.8, 0.6, 0.4, 0.25):
            page.mouse.click(box["x"] + share * box["width"], box["y"] + box["height"] / 2)
            film.take(2 * SHORT)
        session.write({JOINT: now - 0.5})
        run(8)
        film.durations[-1] = 2 * LONG
        film.save(FILE)


if __name__ == "__main__":
    make_small_pictures()
    if sys.argv[1:] != ["small"]:
        take_moving_picture()
