"""Targets picked in a browser on a yard's photo: the file that is saved places the yard; needs Chromium."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from barsight.cli.main import run
from barsight.page.api.serve import ServeOptions, serving
from barsight.registration.yard_file import read_yard_file
from page_yards import DISCS
from test_page_browser import Sheet, address, browser, frame, pytestmark, violations, wait_for
from test_yard_picks import row
from test_yard_tags import LAID, SHIFT, SURVEY_M, TURN

__all__ = ["address", "browser", "pytestmark"]
HEADER = "name,yard_x,yard_y,yard_z,sigma_m,check\n"
LISTED = HEADER + "".join(f"post {k},{x},{y},0,0.001,\n" for k, (x, y) in enumerate(DISCS))
OVER_EDGES = ("--stereo.barsight.refinement.alike-gray", "1000")
"""As the how-to measures targets that are picked: plain discs are matched by their edges."""


def listed(sheet: Sheet, text: str) -> None:
    """Open the screen and give it a list."""
    sheet.open("targets")
    sheet.page.fill("#listed", text)
    sheet.page.click("#take-list .main")
    sheet.page.wait_for_selector("#target-0")


def click_at(page: object, x_m: float, y_m: float, **how: object) -> None:
    px, py = page.evaluate(f"barsightTargets.place({x_m}, {y_m})")
    page.click("#photo", position={"x": px, "y": py}, **how)


def test_picks_by_mouse_and_keyboard_are_kept_and_removed(browser: object, address: str) -> None:
    sheet = Sheet(browser, address, width=1280)
    page = sheet.page
    listed(sheet, LISTED)
    assert violations(page) == []
    for k, (x, y) in enumerate(DISCS):
        click_at(page, x + 0.03, y)
        page.wait_for_selector(f"#remove-{k}")
    page.wait_for_selector("#target-fit >> text=± 0.")
    assert violations(page) == []
    offs = page.eval_on_selector_all(".targets strong", "all => all.map((one) => Number(one.textContent))")
    assert len(offs) == 4 and max(offs) < 5
    command = page.inner_text("#targets code")
    assert command.startswith("barsight calibrate yard targets.csv --measured ")
    assert command.endswith("/second -o yard.yaml")
    page.click("#remove-1")
    page.wait_for_selector("#remove-1", state="detached")
    page.reload()  # what was picked is there again
    page.wait_for_selector("#remove-3")
    assert page.query_selector("#remove-1") is None
    page.click("#target-1")
    page.evaluate(f"Object.assign(barsightTargets.view, {{ x: {DISCS[1][0]}, y: {DISCS[1][1]} }})")
    page.focus("#photo")
    page.keyboard.press("+")
    page.keyboard.press("Enter")
    page.wait_for_selector("#remove-1")
    page.click("#target-1")
    place = "document.querySelector('#target-1').closest('tr').innerText"
    assert "X 0.850 Y 2.000" in page.evaluate(place)
    page.focus("#photo")
    page.keyboard.press("Shift+ArrowRight")
    wait_for(lambda: "X 0.851 Y 2.000" in page.evaluate(place))
    assert "by hand" in page.evaluate(place)
    click_at(page, -1.2, 0.0)
    page.wait_for_selector("#told >> text=post 1: its pick lies where no height was measured")
    assert "X 0.851 Y 2.000" in page.evaluate(place)
    page.click("#other-list")
    page.click("#ask-yes")
    page.wait_for_selector("#listed")
    page.click("#take-list .main")
    page.wait_for_selector("#take-list >> text=list of places: has no target; give one a line")
    assert sheet.outside == [] and sheet.errors == []


def test_clicks_in_a_hurry_take_their_targets_in_turn(browser: object, address: str) -> None:
    sheet = Sheet(browser, address)
    listed(sheet, LISTED)
    for x, y in DISCS[:3]:
        click_at(sheet.page, x, y)
    click_at(sheet.page, *DISCS[2])
    sheet.page.wait_for_selector("#told >> text=post 3: is picked where post 2 is")
    shown = sheet.page.evaluate("barsightTargets.targets")
    assert [one["name"] for one in shown] == ["post 0", "post 1", "post 2"]
    assert np.abs(np.array([one["place_m"][:2] for one in shown]) - DISCS[:3]).max() < 0.001


def disc_in(shot: bytes) -> tuple[float, float]:
    """The middle (px) of the dark disc on white nearest to a screenshot's middle: seen there alone."""
    gray = cv2.imdecode(np.frombuffer(shot, np.uint8), cv2.IMREAD_GRAYSCALE)
    _, _, stats, middles = cv2.connectedComponentsWithStats((gray < 215).astype(np.uint8))
    middle, found = np.array(gray.shape[::-1]) / 2, []
    for (_, _, wide, high, area), at in zip(stats[1:], middles[1:], strict=True):
        if area > 300 and max(wide, high) < 1.3 * min(wide, high) and area > 0.6 * wide * high:
            found.append((float(np.linalg.norm(at - middle)), (float(at[0]), float(at[1]))))
    return min(found)[1]


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    """A rendered yard of 3.6 m with six discs of 0.1 m, measured and in a store."""
    folder = tmp_path_factory.mktemp("picked")
    rows = (f"{k + 3},{x},{y},{z}" for k, (x, y, z) in enumerate(LAID))
    (folder / "laid.csv").write_text("\n".join(["ring,yard_x,yard_y,yard_z", *rows, ""]))
    camera = ("--camera.width-px", "640", "--camera.height-px", "512", "--camera.focal-px", "625")
    yard = ("--camera.above-floor-m", "6", "--yard.max-layers", "2", "--yard.bar-length-m", "5")
    words = ("--length", "3.6", "--frames", "12", "--seed", "8665", "--depth-views", "0", *camera, *yard)
    recording, store = str(folder / "recording"), f"sqlite:///{folder / 'yard.db'}"
    assert run(["simulate", recording, *words, "--tags", str(folder / "laid.csv"), "--tag-m", "0.1"]) == 0
    assert run(["measure", recording, "-o", str(folder / "out"), *OVER_EDGES]) == 0
    assert run(["store", "add", store, str(folder / "out")]) == 0
    with serving(store, ServeOptions(port=0)) as address:
        yield folder, address


def test_what_is_picked_on_a_rendered_yard_places_it(
    browser: object, surveyed: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Looked at closely and clicked where the disc is in the screenshot, two pixels beside its middle."""
    folder, served = surveyed
    true = LAID @ TURN.T + SHIFT
    survey = true + np.random.default_rng(8665).normal(0, SURVEY_M, (6, 3))
    sheet = Sheet(browser, served, width=1280)
    page, rng = sheet.page, np.random.default_rng(8666)
    listed(sheet, HEADER + "".join(row(k, place) for k, place in enumerate(survey)))
    box = page.locator("#photo").bounding_box()
    for k, (x, y, _) in enumerate(LAID):
        aside = rng.uniform(-0.05, 0.05, 2)
        looked = {"x": x + aside[0], "y": y + aside[1], "scale": 500}
        page.evaluate(f"Object.assign(barsightTargets.view, {json.dumps(looked)}); barsightTargets.draw()")
        frame(page)
        left, top = box["x"] + box["width"] / 2 - 120, box["y"] + box["height"] / 2 - 120
        shot = page.screenshot(clip={"x": left, "y": top, "width": 240, "height": 240})
        page.mouse.click(*np.add((left, top), disc_in(shot)) + rng.normal(0, 2, 2))
        page.wait_for_selector(f"#remove-{k}")
    with page.expect_download() as saved:
        page.click("#save-targets")
    out, file = tmp_path / "yard.yaml", tmp_path / saved.value.suggested_filename
    saved.value.save_as(file)
    assert file.name == "targets.csv" and sheet.errors == []
    capsys.readouterr()
    assert run(["calibrate", "yard", str(file), "--measured", str(folder / "out"), "-o", str(out)]) == 0
    told = capsys.readouterr().err
    placed = read_yard_file(out)
    assert placed.yard_from.source == "encoders" and placed.doubts == ()
    off_m = np.linalg.norm(placed.yard_from.apply(LAID) - true, axis=1)
    assert off_m.max() < 0.008
    checks = [line for line in told.splitlines() if line.startswith("check")]
    assert len(checks) == 2
    for line in checks:
        *off, _, _, sigma = line.split(": off ")[1].split()
        assert np.linalg.norm([float(value) for value in off]) < 2 * 3**0.5 * float(sigma)
