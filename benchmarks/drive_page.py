"""Drive the page in a real browser without a screen: load, play, scrub, change planner, compare two; screenshots.

Needs playwright (pip install playwright) and a Chromium beside the extra `view`:

python benchmarks/drive_page.py --out docs --chromium /usr/bin/chromium
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from PIL import Image

from torchdyn_plan.tasks import load_task
from torchdyn_plan.view import Page, Scenario

# WebGL by software, and a browser that talks to nobody.
FLAGS = (
    "--no-sandbox --disable-gpu --use-angle=swiftshader --enable-unsafe-swiftshader --ignore-gpu-blocklist "
    "--disable-quic --no-first-run --disable-background-networking --disable-component-update --disable-sync"
)
SETTLE = 6.0
"""A browser that draws by software has drawn what it was sent after so long [s]."""
PATIENCE = 120.0
"""What does not happen within this time has failed [s]."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Which episode is looked at, and where the screenshots go."""

    out: Path
    """Folder of the screenshots."""
    chromium: str = "/usr/bin/chromium"
    """The browser."""
    port: int = 8390
    """Of the page."""
    task: str = "trapper"
    """The task."""
    planner: str = "wait_and_drop"
    """The first planner."""
    beside: str = "corner"
    """The planner that is put beside it."""
    other: str = "exact"
    """The planner that takes the first one's place."""
    episode: int = 2
    """Number of the episode."""
    scrub: int = 65
    """Control step of the screenshots."""


class Driver:
    """A person at the page."""

    def __init__(self, browser_page: Any, page: Page, out: Path) -> None:
        """Sit down before a browser's tab that shows ``page``; screenshots go to the folder ``out``."""
        self.tab, self.page, self.out = browser_page, page, out

    def until(self, what: str, holds: Callable[[], bool]) -> None:
        """Wait until ``holds``; raises `SystemExit` with ``what`` if it never does."""
        begun = time.monotonic()
        while not holds():
            if time.monotonic() - begun > PATIENCE:
                raise SystemExit(f"failed: {what}; the page says {self.says()!r}")
            time.sleep(0.1)
        print(f"{what}: {time.monotonic() - begun:.1f} s")

    def says(self) -> str:
        """What the panel says at its top."""
        return self.tab.inner_text("body").split("Playback")[0].split("torchdyn-plan")[-1].strip()

    def scrub(self, step: int) -> None:
        """Type ``step`` into the scrubber's box; a page that plays would type over it."""
        if self.page.playing:
            self.press("Pause")
            self.until("paused", lambda: not self.page.playing)
        box = self.tab.locator("input[type=text]:visible").first
        box.fill(str(step))
        box.press("Enter")
        self.until(f"scrubbed to {step}", lambda: int(self.page.step) == step)

    def choose(self, number: int, value: str) -> None:
        """Choose ``value`` in the drop-down of that ``number`` from the top."""
        self.tab.locator("input[aria-haspopup=listbox]:visible").nth(number).click()
        self.tab.get_by_role("option", name=value, exact=True).click()

    def press(self, name: str) -> None:
        """Press a button."""
        self.tab.get_by_role("button", name=name, exact=True).click()

    def shoot(self, name: str) -> None:
        """Save a screenshot, once everything is drawn."""
        time.sleep(SETTLE)
        image = Image.open(io.BytesIO(self.tab.screenshot()))
        image.convert("RGB").save(self.out / f"{name}.webp", quality=70, method=6)
        print(f"{name}: {self.says()!r}")


def drive(driver: Driver, arguments: Arguments) -> None:
    """Do what a person does, and see that it has come to pass."""
    page, first, second, third = driver.page, arguments.planner, arguments.beside, arguments.other

    def shows(*planners: str) -> bool:
        return tuple(recording.scenario.planner for recording in page.recordings) == planners

    driver.tab.get_by_text("Playback").wait_for()
    driver.until("recorded", lambda: shows(first))
    driver.until("plays", lambda: page.step > 5)
    driver.until("played to the end", lambda: page.step >= page.length and not page.playing)
    driver.scrub(arguments.scrub)
    driver.shoot("view-one")
    driver.choose(2, second)
    driver.until(f"{second} beside", lambda: shows(first, second))
    driver.until("both play", lambda: page.step > 5)
    driver.scrub(arguments.scrub)
    driver.shoot("view-two")
    driver.press(">|")
    driver.until("at the end", lambda: page.step >= page.length)
    driver.shoot("view-end")
    driver.choose(1, third)
    driver.until(f"{third} in place of {first}", lambda: shows(third, second))
    driver.press("Pause")
    driver.until("paused", lambda: not page.playing)
    before = int(page.step)
    driver.press(">")
    driver.until("a step on", lambda: int(page.step) == before + 1)


def main(arguments: Arguments) -> None:
    """Serve the page, and drive it."""
    from playwright.sync_api import sync_playwright

    arguments.out.mkdir(parents=True, exist_ok=True)
    scenario = Scenario(task=load_task(arguments.task), planner=arguments.planner, episode=arguments.episode)
    page = Page([scenario], port=arguments.port)
    try:
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=arguments.chromium, args=FLAGS.split())
            tab = browser.new_page(viewport={"width": 1280, "height": 720})
            tab.set_default_timeout(1000 * PATIENCE)
            tab.goto(page.address)
            # What viser says of drawing by software is about this machine.
            tab.add_style_tag(content="[class*=Notification] { display: none !important }")
            drive(Driver(tab, page, arguments.out), arguments)
            browser.close()
    finally:
        page.close()


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
