"""Take the pictures of docs/how-to/run-the-page.md: `python tools/page_pictures.py`."""

from __future__ import annotations

import importlib
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from playwright.sync_api import Page, sync_playwright

from barsight.page.api.serve import ServeOptions, serving

ROOT = Path(__file__).parents[1]
SCREENS = ("yard", "lifts", "alarms", "timeline", "targets")
TURN, SHIFT_M = np.array([[0.8, -0.6], [0.6, 0.8]]), (100.0, 20.0)
"""Of the surveyed targets' yard."""


def main() -> None:
    """Serve a store of two surveys and write a picture of each screen."""
    sys.path.insert(0, str(ROOT / "tests"))
    yards = importlib.import_module("page_yards")

    with (
        tempfile.TemporaryDirectory() as folder,
        serving(yards.fill_store(Path(folder)), ServeOptions(port=0)) as address,
        sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1400, "height": 800}, locale="en")
        for name in SCREENS:
            page.goto(f"{address}/#{name}")
            page.wait_for_timeout(1500)
            if name == "yard":
                page.focus("#yard")
                for _ in range(5):
                    page.keyboard.press("n")
                page.wait_for_timeout(300)
            if name == "targets":
                pick(page, yards.DISCS)
            page.screenshot(path=ROOT / "docs" / "pictures" / f"page_{name}.jpg", type="jpeg", quality=70)
        browser.close()


def pick(page: Page, discs: Sequence[tuple[float, float]]) -> None:
    """List the discs as surveyed, and click beside each."""
    rows = [f"post {k},{x:.4f},{y:.4f},0.0010,0.001," for k, (x, y) in enumerate(discs @ TURN.T + SHIFT_M)]
    page.fill("#listed", "\n".join(["name,yard_x,yard_y,yard_z,sigma_m,check", *rows]))
    page.click("#take-list .main")
    page.wait_for_selector("#target-0")
    for k, (x_m, y_m) in enumerate(discs):
        x, y = page.evaluate(f"barsightTargets.place({x_m}, {y_m})")
        page.click("#photo", position={"x": x + 1, "y": y})
        page.wait_for_selector(f"#remove-{k}")


if __name__ == "__main__":
    main()
