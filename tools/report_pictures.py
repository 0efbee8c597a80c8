"""Take the report's pictures in docs/pictures: `python tools/report_pictures.py demo/result`."""

from __future__ import annotations

import io
import shutil
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

PICTURES = Path(__file__).parents[1] / "docs" / "pictures"
PARTS = {
    "report_summary": "section.figures",
    "report_height": "#map-height",
    "report_lifts": "#yard figure.map:last-of-type",
    "report_contour": "#contours figure.plot",
    "report_pair": "#preview figure",
}
"""CSS selector of each picture's part of the report."""
WIDTH_PX, TABLES_PX = 1180, 720
"""Width of the browser's window; height of the picture that shows the tables of lifts."""


def main(folder: Path) -> None:
    """Write a picture of each part of a folder's report."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": WIDTH_PX, "height": 900})
        page.goto((folder / "report.html").absolute().as_uri())
        page.wait_for_timeout(2500)
        for name, selector in PARTS.items():
            _save(name, page.locator(selector).first.screenshot())
        page.evaluate("window.scrollTo(0, 0)")
        box = page.get_by_role("heading", name="Lifts", exact=True).bounding_box()
        assert box is not None
        left, width = box["x"] - 12, WIDTH_PX - 2 * box["x"] + 24
        _save(
            "report_tables",
            page.screenshot(
                full_page=True, clip={"x": left, "y": box["y"], "width": width, "height": TABLES_PX}
            ),
        )
        browser.close()


def _save(name: str, png: bytes) -> None:
    Image.open(io.BytesIO(png)).convert("RGB").save(PICTURES / f"{name}.jpg", quality=85)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
