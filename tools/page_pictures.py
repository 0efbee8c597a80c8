"""Take the pictures of docs/how-to/run-the-page.md: `python tools/page_pictures.py`."""

from __future__ import annotations

import importlib
import shutil
import sys
import tempfile
from pathlib import Path

from playwright.sync_api import sync_playwright

from barsight.page.serve import ServeOptions, serving

ROOT = Path(__file__).parents[1]
SCREENS = ("yard", "lifts", "alarms", "timeline")


def main() -> None:
    """Serve a store of two surveys and write a picture of each screen."""
    sys.path.insert(0, str(ROOT / "tests"))
    fill_store = importlib.import_module("page_yards").fill_store

    with (
        tempfile.TemporaryDirectory() as folder,
        serving(fill_store(Path(folder)), ServeOptions(port=0)) as address,
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
            page.screenshot(path=ROOT / "docs" / "pictures" / f"page_{name}.jpg", type="jpeg", quality=70)
        browser.close()


if __name__ == "__main__":
    main()
