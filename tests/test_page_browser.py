"""The page in a browser: screens by mouse and keyboard, two browsers, a server that ends; needs Chromium."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from barsight.page import watch as watching
from barsight.page.api.serve import ServeOptions, serving
from barsight.report.page import write_report
from barsight.store.accounts import add_person
from barsight.store.audit import entry
from barsight.store.confirmation import confirm_lift, end_lift, open_lifts
from barsight.store.opening import open_store
from barsight.store.states import last_raised_ns
from live_folders import beating, live_folder
from opcua_servers import node_package
from result_folders import write_folder

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed (bash .ci/servers)"),
    pytest.mark.slow,
]
SCREENS = (
    "yard", "model", "bundle", "lifts", "stock", "alarms", "timeline", "surveys", "targets", "health",
    "admin",
)  # fmt: skip
GRAPHICS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""WebGL without a graphics card."""
PASSWORD = "four words that nobody guesses"
WORDS = Path(__file__).parents[1] / "src" / "barsight" / "page" / "static" / "words.json"


@pytest.fixture(scope="module")
def browser() -> Iterator[object]:
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(GRAPHICS))
        yield browser
        browser.close()


class Sheet:
    """A page, what it asked for from elsewhere, and its errors."""

    def __init__(
        self, browser: object, address: str, locale: str = "en", *, width: int = 1500, wait: str = "#yard"
    ) -> None:
        self.context = browser.new_context(locale=locale, viewport={"width": width, "height": 850})
        self.page = self.context.new_page()
        self.address = address
        self.outside: list[str] = []
        self.errors: list[str] = []
        self.page.on("request", lambda r: None if r.url.startswith(address) else self.outside.append(r.url))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(address)
        self.page.wait_for_selector(wait)

    def open(self, name: str) -> None:
        self.page.click(f"#nav-{name}")
        self.page.wait_for_selector(f"body[data-shown={name}] #nav-{name}[aria-current]")


@pytest.fixture
def address(url: str) -> Iterator[str]:
    with serving(url, ServeOptions(port=0)) as address:
        yield address


def wait_for(holds: Callable[[], bool], timeout_s: float = 5.0) -> None:
    """The page's policy forbids Playwright to wait inside it."""
    end_s = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def test_a_bundles_age_goes_on_while_nothing_changes(browser: object, address: str) -> None:
    context = browser.new_context(locale="en", viewport={"width": 1500, "height": 850})
    page = context.new_page()
    page.clock.install()
    page.goto(f"{address}/#yard")
    page.click("[id^=pick-]")
    assert " h" not in (page.text_content("#side dl:last-of-type") or "")
    page.clock.fast_forward(2 * 3600 * 1000)
    wait_for(lambda: "2.0 h" in (page.text_content("#side dl:last-of-type") or ""))
    context.close()


def test_readings_of_the_crane_are_shown_where_they_are_not_the_place(browser: object, address: str) -> None:
    """The magnet of one lift hangs 0.2 m off the readings; the other lifts' readings are their places."""
    sheet = Sheet(browser, address)
    number = sheet.page.evaluate("fetch('/api/lifts').then((answer) => answer.json())")["lifts"][0]["id"]

    def move(route: object) -> None:
        answer = route.fetch()
        content = answer.json()
        moved = content["lifts"][0]
        moved["target"]["x_m"], moved["crane_target"]["x_m"] = 3.0, 2.8
        route.fulfill(response=answer, json=content)

    sheet.page.route("**/api/lifts", move)
    sheet.page.reload()
    sheet.open("lifts")
    panels = {
        one.get_attribute("id"): one.inner_text() for one in sheet.page.query_selector_all(".lifts > *")
    }
    told = panels.pop(f"lift-{number}")
    assert "X 3.00" in told and "Target, crane's readings" in told and "X 2.80" in told
    assert panels and not any("Target, crane's" in other for other in panels.values())
    assert not sheet.errors
    sheet.context.close()


@pytest.mark.parametrize("reported", ["taken", "failed"])
def test_a_lift_that_was_made_late_is_told_among_those_that_ended(
    browser: object, address: str, url: str, reported: str
) -> None:
    with open_store(url) as store:
        with store.reading() as connection:
            first, second, *_ = open_lifts(connection)
        confirm_lift(store, first.lift_id, first.map_id, "ann")
        for lift in (first, second):
            end_lift(store, lift.lift_id, "expired", "ann", "its time is over")
    sheet = Sheet(browser, address)
    sheet.open("lifts")
    assert not sheet.page.query_selector(f"#taken-{second.lift_id}"), "it was never confirmed"
    sheet.page.click(f"#taken-{first.lift_id}")
    assert "can't be recorded any more" in sheet.page.inner_text("dialog")
    sheet.page.click("dialog button[type=button]")
    sheet.page.wait_for_selector("dialog", state="detached")
    with open_store(url) as store, store.reading() as connection:
        assert last_raised_ns(connection, "lift-unrecorded") is None, "it was only asked for"
    sheet.page.click(f"#{reported}-{first.lift_id}")
    assert "can't be recorded any more" in sheet.page.inner_text("dialog")
    if reported == "failed":
        sheet.page.fill("#ask-note", "slipped")
    sheet.page.click("#ask-yes")
    wait_for(lambda: "survey before the next lift" in (sheet.page.text_content("#told") or ""))
    sheet.open("alarms")
    wait_for(lambda: "could not be recorded" in sheet.page.content())
    assert not sheet.errors
    sheet.context.close()


def test_every_screen_by_mouse_and_by_keyboard(browser: object, address: str) -> None:
    sheet = Sheet(browser, address)
    page = sheet.page
    heads = {}
    for name in SCREENS:
        sheet.open(name)
        heads[name] = page.inner_text("#screen h1 >> nth=0")
    assert len(set(heads.values())) == len(SCREENS) - 1  # beside the yard stand its lifts
    page.reload()
    page.wait_for_selector("#nav-admin")
    page.keyboard.press("Tab")
    reached = []
    for _ in range(17):
        page.keyboard.press("Tab")
        reached.append(page.evaluate("document.activeElement.id"))
        if reached[-1].startswith("nav-"):
            page.keyboard.press("Enter")
            name = reached[-1][4:]
            page.wait_for_selector(f"body[data-screen={name}] #nav-{name}[aria-current]")
            wait_for(lambda: page.evaluate("document.activeElement.id") == "screen")
            page.focus(f"#nav-{name}")
    assert [f"nav-{name}" for name in SCREENS] == [each for each in reached if each.startswith("nav-")]
    assert sheet.outside == [] and sheet.errors == []


def test_the_yard_by_keyboard_and_why_not(browser: object, address: str) -> None:
    sheet = Sheet(browser, address)
    page = sheet.page
    page.focus("#yard")
    for _ in range(5):
        page.keyboard.press("n")
    page.wait_for_selector("#side >> text=B6")
    side = page.inner_text("#side")
    assert "Move the trolley towards +Y until the end is in view" in side and "end-open" in side
    scale = page.evaluate("barsightYard.view.scale")
    page.keyboard.press("+")
    page.keyboard.press("ArrowRight")
    assert page.evaluate("barsightYard.view.scale") == pytest.approx(1.25 * scale)
    page.keyboard.press("0")
    place = page.evaluate("barsightYard.place(0.3, 2.0)")
    page.click("#yard", position={"x": place[0], "y": place[1]})
    page.wait_for_selector("#side >> text=Confirm lift")
    assert sheet.errors == []


def test_the_yard_by_mouse_and_on_paper(browser: object, address: str) -> None:
    sheet = Sheet(browser, address)
    page = sheet.page
    wait_for(lambda: page.evaluate("barsightYard.view !== null"))
    scale, x = page.evaluate("[barsightYard.view.scale, barsightYard.view.x]")
    page.mouse.move(500, 400)
    page.mouse.wheel(0, -400)
    wait_for(lambda: page.evaluate("barsightYard.view.scale") > 2 * scale)
    zoomed = page.evaluate("barsightYard.view.x")
    page.mouse.down()
    page.mouse.move(400, 400, steps=4)
    page.mouse.up()
    assert page.evaluate("barsightYard.view.x") > zoomed
    page.click("#whole")
    assert page.evaluate("barsightYard.view.x") == pytest.approx(x)
    page.click("#as-height")
    page.wait_for_selector("#as-height[aria-pressed=true]")
    page.emulate_media(media="print")
    assert not page.is_visible("nav") and not page.is_visible("#print") and page.is_visible("#yard")
    assert page.pdf(format="A4", landscape=True).count(b"/Type /Page\n") == 1
    assert sheet.errors == []


def test_a_wall_and_a_glove(browser: object, address: str) -> None:
    """A wall screen shows all larger and picks where it is clicked; a finger has 44 px for each aim."""
    wall = browser.new_page(locale="en", viewport={"width": 3840, "height": 2160})
    wall.goto(address)
    wall.wait_for_selector("#side >> text=offered")
    wait_for(lambda: wall.evaluate("barsightYard.width > 0"))
    box, width = wall.locator("#yard").bounding_box(), wall.evaluate("barsightYard.width")
    assert box["width"] > 1.5 * width and wall.evaluate("document.querySelector('#yard').width") > 1.5 * width
    x, y = (box["width"] / width * each for each in wall.evaluate("barsightYard.place(0.3, 2.0)"))
    wall.mouse.click(box["x"] + x, box["y"] + y)
    wall.wait_for_selector("#side >> text=Ends in")
    tablet = browser.new_page(
        locale="de", viewport={"width": 1024, "height": 768}, has_touch=True, is_mobile=True
    )
    tablet.goto(f"{address}/#lifts")
    tablet.wait_for_selector("#confirm-1")
    aims = tablet.query_selector_all("button, nav a, select")
    assert min(one.bounding_box()["height"] for one in aims) >= 44
    wall.close()
    tablet.close()


PIXELS = """() => {
  const canvas = document.querySelector("canvas");
  const copy = document.createElement("canvas");
  Object.assign(copy, { width: canvas.width, height: canvas.height });
  const pen = copy.getContext("2d", { willReadFrequently: true });
  pen.drawImage(canvas, 0, 0);
  const { data } = pen.getImageData(0, 0, copy.width, copy.height);
  return Array.from({ length: data.length / 4 }, (_, k) => data[4 * k + 1]);
}"""


def pixels(page: object) -> np.ndarray:
    """The green of each pixel of the first canvas."""
    return np.array(page.evaluate(PIXELS))


def frame(page: object) -> None:
    """Two frames on: what was asked for is drawn."""
    page.evaluate(
        "new Promise((go) => requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(go, 50))))"
    )


def test_a_yard_that_is_moved_looks_as_one_that_is_drawn_there(browser: object, address: str) -> None:
    sheet = Sheet(browser, address)
    page = sheet.page
    wait_for(lambda: page.evaluate("barsightYard.pictures.size > 0"))
    frame(page)
    before = pixels(page)
    for _ in range(6):
        page.evaluate("barsightYard.pan(90, 40)")
        frame(page)
    moved = pixels(page)
    page.evaluate("barsightYard.moving = null; barsightYard.draw()")
    frame(page)
    drawn = pixels(page)
    assert (np.abs(before - moved) > 30).mean() > 0.1
    assert (np.abs(moved - drawn) > 30).mean() < 0.02  # lines and names at the edges
    assert sheet.errors == []


def test_the_yard_in_three_dimensions(browser: object, address: str) -> None:
    sheet = Sheet(browser, address)
    page = sheet.page
    sheet.open("model")
    wait_for(lambda: page.evaluate("barsightModel?.frames > 0"))
    frame(page)
    first = pixels(page)
    assert (np.abs(first - 0xC8) > 20).mean() > 0.05  # of the ground's
    assert page.evaluate("barsightModel.packed.head.points") > 10_000
    assert [name for name, _ in page.evaluate("barsightModel.packed.head.lines")] == ["free", "axes", "poles"]
    box = page.locator("#model").bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    turn, distance = page.evaluate("[barsightModel.looks.turn, barsightModel.looks.distance]")
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 120, middle[1], steps=3)
    page.mouse.up()
    page.mouse.wheel(0, -300)
    wait_for(lambda: page.evaluate("barsightModel.looks.distance") < 0.7 * distance)
    assert page.evaluate("barsightModel.looks.turn") == pytest.approx(turn - 120 / 180)
    frame(page)
    assert (pixels(page) != first).mean() > 0.05
    page.focus("#model")
    page.keyboard.press("0")
    assert page.evaluate("barsightModel.looks.turn") == pytest.approx(turn)
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("Shift+ArrowUp")
    page.keyboard.press("+")
    assert page.evaluate("barsightModel.looks.distance") == pytest.approx(0.8 * distance)
    page.select_option("#model-by", "source")
    wait_for(lambda: "vision" in page.inner_text("#model-told"))
    older = page.evaluate("document.querySelector('#model-survey').options[1].value")
    page.select_option("#model-survey", older)
    wait_for(lambda: page.evaluate("barsightModel.packed.head.lines.length") == 2)  # it has no lifts
    assert sheet.outside == [] and sheet.errors == []


def test_a_bundle_has_pictures_of_each_survey_and_its_history(browser: object, address: str) -> None:
    sheet = Sheet(browser, address)
    page = sheet.page
    sheet.open("bundle")
    page.focus("#see-B1")
    page.keyboard.press("Enter")
    page.wait_for_selector("#pictures img >> nth=1")
    shown = "[...document.querySelectorAll('#pictures img')].map((one) => one.naturalWidth)"
    wait_for(lambda: min(page.evaluate(shown)) > 300)
    assert page.evaluate("document.querySelectorAll('#screen tbody tr').length") == 2
    assert sheet.errors == []


def test_two_times_are_compared_by_keyboard(browser: object, address: str) -> None:
    sheet = Sheet(browser, address)
    page = sheet.page
    sheet.open("timeline")
    page.wait_for_selector("tbody tr")
    told = {row.split("\t")[0]: row.split("\t")[1] for row in page.inner_text("tbody").splitlines()}
    assert told == {"B4": "went", "B6": "came"}
    page.focus("#before")
    page.keyboard.press("ArrowRight")
    page.wait_for_selector("text=Nothing came, went or moved.")
    page.focus("#after")
    page.keyboard.press("ArrowLeft")
    page.wait_for_selector("tbody tr")
    assert page.evaluate("document.querySelector('#after-text').textContent") < page.evaluate(
        "document.querySelector('#before-text').textContent"
    )
    assert sheet.errors == []


def test_the_crane_goes_over_the_yard_as_the_live_run_tells(
    browser: object, url: str, tmp_path: Path
) -> None:
    live = live_folder(tmp_path / "live", crane_m=[2.4, 1.1, 7.0])
    with serving(url, ServeOptions(port=0, live=live)) as address:
        sheet = Sheet(browser, address)
        with beating(live):
            sheet.page.wait_for_selector("#crane >> text=all sensors")
            wait_for(lambda: sheet.page.evaluate("barsightYard.crane?.body_m[0]") == 3.0)
            wait_for(lambda: "Map age at the crane" in sheet.page.inner_text("#age"))
            assert "never" not in sheet.page.inner_text("#age")
            live_folder(live, position_m=[4.0, 1.0, 8.0], mode="no-imu")
            wait_for(lambda: sheet.page.evaluate("barsightYard.crane?.body_m[0]") == 4.0, 1.0)
            sheet.page.wait_for_selector("#crane >> text=without IMU")
            live_folder(live, position_m=[400.0, 1.0, 8.0])
            wait_for(lambda: "never seen" in sheet.page.inner_text("#age"))
        sheet.page.wait_for_selector("#crane >> text=no data", timeout=5000)  # it writes no more
        assert sheet.page.evaluate("barsightYard.crane") is None
        assert "Age of the newest map" in sheet.page.inner_text("#age")
        assert sheet.errors == []


def log_in(page: object, name: str) -> None:
    page.fill("#name", name)
    page.fill("#password", PASSWORD)
    page.keyboard.press("Enter")
    page.wait_for_selector("#yard")


def test_a_viewer_s_page_that_is_changed_changes_nothing(browser: object, url: str) -> None:
    """A viewer has gray buttons; made to work by hand, they are refused by the API."""
    with open_store(url) as store, entry(store, "ann", "accounts") as opened:
        add_person(opened, "ann", "engineer", PASSWORD)
        add_person(opened, "vic", "viewer", PASSWORD)
    with serving(url, ServeOptions(port=0)) as address:
        sheet = Sheet(browser, address, wait="#log-in")
        page = sheet.page
        log_in(page, "vic")
        sheet.open("lifts")
        page.wait_for_selector("[id^=confirm-]")
        assert page.evaluate("document.querySelectorAll('.lifts button:not(:disabled)').length") == 0
        page.evaluate("document.querySelectorAll('button').forEach((one) => { one.disabled = false; })")
        page.click("[id^=confirm-] >> nth=0")
        page.click("#ask-yes")
        page.wait_for_selector("#told >> text=the role viewer may not operate")
        sheet.open("admin")
        page.wait_for_selector("text=Accounts are kept by engineers.")
        lifts = page.evaluate("fetch('/api/lifts').then((answer) => answer.json())")["lifts"]
        assert {one["state"] for one in lifts} == {"offered"}
        assert sheet.errors == []


def violations(page: object) -> list[str]:
    """Rules of axe-core that the page breaks as it is shown, each with the first place."""
    page.evaluate((node_package("axe-core") / "axe.min.js").read_text(encoding="utf-8"))
    found = page.evaluate("axe.run()")["violations"]
    return [f"{one['id']}: {one['nodes'][0]['html'][:200]}" for one in found]


@pytest.mark.parametrize("width", [1500, 800])
def test_no_screen_breaks_a_rule_of_accessibility(
    browser: object, url: str, tmp_path: Path, width: int
) -> None:
    live = live_folder(tmp_path / "live", crane_m=[2.4, 1.1, 7.0])
    with serving(url, ServeOptions(port=0, live=live)) as address:
        sheet = Sheet(browser, address, width=width)
        page, broken = sheet.page, {}
        for name in SCREENS:
            sheet.open(name)
            broken[name] = violations(page)
        page.goto(f"{address}/#bundle/B6")
        page.wait_for_selector("#pictures img")
        broken["one bundle"] = violations(page)
        sheet.open("lifts")
        page.click("[id^=confirm-] >> nth=0")
        page.wait_for_selector("dialog")
        broken["dialog"] = violations(page)
        page.keyboard.press("Escape")
        sheet.open("yard")
        page.focus("#yard")
        page.keyboard.press("n")
        page.wait_for_selector("#to-bundle")
        broken["bundle beside the yard"] = violations(page)
    with open_store(url) as store, entry(store, "ann", "account") as opened:
        add_person(opened, "ann", "engineer", PASSWORD)
    with serving(url, ServeOptions(port=0)) as address:
        broken["log in"] = violations(Sheet(browser, address, wait="#log-in", width=width).page)
    assert {name: rules for name, rules in broken.items() if rules} == {}


def confirm(page: object) -> None:
    page.click("[id^=confirm-]:enabled >> nth=0")
    page.fill("#ask-name", "Ann")
    page.click("#ask-yes")


def test_two_browsers_agree_within_a_second(browser: object, address: str) -> None:
    one, two = Sheet(browser, address), Sheet(browser, address, "de")
    one.open("lifts")
    two.open("lifts")
    one.page.wait_for_selector("[id^=confirm-]")
    confirm(one.page)
    two.page.wait_for_selector("li.at >> text=bestätigt", timeout=1000)
    one.page.wait_for_selector("li.at >> text=confirmed", timeout=1000)
    two.page.click("[id^=taken-]")
    one.page.wait_for_selector("table >> text=taken", timeout=1000)
    assert one.errors == two.errors == []


def forbid_lifts(page: object) -> int:
    """Forbid all lifts by the API, beside the page; return the answer's status."""
    return page.evaluate(
        """async () => {
          const token = (await (await fetch("/api/session")).json()).token;
          const headers = {"X-Barsight-Token": token, "Content-Type": "application/json"};
          const body = JSON.stringify({code: "disturbed", reason: "a lorry"});
          return (await fetch("/api/vetoes", {method: "POST", headers, body})).status;
        }"""
    )


def test_a_stale_offer_cannot_be_confirmed(browser: object, address: str) -> None:
    """The dialog stands open while a veto comes: it is left, and the page says so."""
    sheet = Sheet(browser, address)
    sheet.open("lifts")
    page = sheet.page
    page.click("[id^=confirm-] >> nth=0")
    page.fill("#ask-name", "Ann")
    assert forbid_lifts(page) == 200
    page.wait_for_selector("dialog", state="detached")
    page.wait_for_selector("#told >> text=has changed")
    lifts = page.evaluate("fetch('/api/lifts').then((answer) => answer.json())")["lifts"]
    assert {one["state"] for one in lifts} == {"expired"}
    sheet.open("bundle")
    assert page.inner_text("#screen tbody").count("disturbed") == 5, "it forbids the whole map"


def test_a_page_that_hears_nothing_offers_nothing(
    browser: object, address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The network or the store falls silent without an error: no screen shows an offer until a beat comes."""
    sheet = Sheet(browser, address, wait="#side >> text=offered")
    page = sheet.page
    page.clock.install()
    offered = "[...document.querySelectorAll('#screen [id^=confirm-], #screen [id^=pick-]')].length"
    sheet.open("lifts")
    page.click("[id^=confirm-] >> nth=0")
    monkeypatch.setattr(watching, "FRESH_S", -1.0)
    page.clock.fast_forward(11_000)
    page.wait_for_selector("#server >> text=no lift is offered")
    page.wait_for_selector("dialog", state="detached")
    wait_for(lambda: page.evaluate(offered) == 0)
    sheet.open("yard")
    page.wait_for_selector("#side >> text=No connection to the server")
    assert page.evaluate(offered) == 0 and page.evaluate("barsightYard.data.lifts.length") == 0
    page.evaluate("location.hash = 'bundle/B1'")
    page.wait_for_selector("#screen >> text=No connection to the server")
    assert page.evaluate(offered) == 0
    monkeypatch.setattr(watching, "FRESH_S", 10.0)
    page.wait_for_selector("#confirm-1")
    assert "connected" in page.inner_text("#server") and not sheet.errors


def test_an_answer_that_is_cut_off_is_none(browser: object, address: str) -> None:
    """On a slow network the time for an answer may end amid its content: it counted as an empty one."""
    sheet = Sheet(browser, address, wait="#side >> text=offered")
    cut = {"status": 200, "content_type": "application/json", "body": '{"lifts": ['}
    sheet.page.route("**/api/lifts", lambda route: route.fulfill(**cut))
    sheet.page.reload()
    sheet.page.wait_for_selector("#told >> text=No answer from the server")
    sheet.page.unroute("**/api/lifts")
    sheet.open("lifts")
    sheet.page.wait_for_selector("#confirm-1")
    assert not sheet.errors


def test_a_server_that_ends_and_comes_back(browser: object, url: str) -> None:
    with serving(url, ServeOptions(port=0)) as address:
        sheet = Sheet(browser, address)
        sheet.open("lifts")
        sheet.page.wait_for_selector("[id^=confirm-]")
    sheet.page.wait_for_selector("#server >> text=no connection")
    with serving(url, ServeOptions(port=int(address.rsplit(":", 1)[1]))):
        sheet.page.wait_for_selector("#server >> text=/^connected/", timeout=15_000)
        wait_for(lambda: "no connection" not in sheet.page.inner_text("#server"))
        confirm(sheet.page)
        sheet.page.wait_for_selector("li.at >> text=confirmed")


def test_alarms_stock_and_accounts_by_the_page(browser: object, address: str) -> None:
    sheet = Sheet(browser, address)
    page = sheet.page
    sheet.open("alarms")
    page.click("[id^=ack-]")
    page.wait_for_selector("text=active, acknowledged")
    sheet.open("stock")
    page.click("#accept-0")
    page.click("#ask-yes")
    page.wait_for_selector("text=accepted: the list is to be changed")
    with page.expect_download() as told:
        page.click("#stock-list")
    assert Path(told.value.path()).read_text(encoding="utf-8").startswith("name,x_m,y_m,")
    sheet.open("health")
    page.click("[id^=approve-]")
    page.fill("#ask-until", "2100-01-01")
    page.click("#ask-yes")
    page.wait_for_selector("#calibrations >> text=2100-01-01 00:00:00 UTC")
    assert "valid" in page.inner_text("#calibrations tbody") and "local" in page.inner_text("#calibrations")
    sheet.open("surveys")
    page.wait_for_selector("h1 >> text=Recordings")
    sheet.open("admin")
    page.click("#add-person")
    page.fill("#ask-name", "eve")
    page.fill("#ask-password", PASSWORD)
    page.click("#ask-yes")
    page.wait_for_selector("#log-in")
    page.fill("#name", "eve")
    page.fill("#password", "wrong wrong wrong")
    page.keyboard.press("Enter")
    page.wait_for_selector("text=Name or password is wrong")
    page.fill("#password", PASSWORD)
    page.keyboard.press("Enter")
    page.wait_for_selector("#log-out")
    assert sheet.errors == []


def test_the_catalogue_is_whole_in_three_languages(browser: object, address: str) -> None:
    from barsight.page.conditions import ALARM_CODES
    from barsight.yard.vetoes import VETOES

    words = json.loads(WORDS.read_text(encoding="utf-8"))
    assert {len(texts) for texts in words.values()} == {3}
    assert all(text.strip() for texts in words.values() for text in texts)
    wanted = {f"{kind}.{code}" for code in VETOES for kind in ("veto", "short")}
    wanted |= {f"help.{code}" for code in VETOES}
    wanted |= {f"{kind}.{code}" for code in ALARM_CODES for kind in ("alarm", "cause", "action")}
    assert wanted <= set(words)
    for locale, word in (("de", "Platz"), ("zh-CN", "料场")):
        sheet = Sheet(browser, address, locale)
        assert sheet.page.inner_text("#nav-yard") == word
        for name in SCREENS:
            sheet.open(name)
            shown = sheet.page.inner_text("body")
            assert not [key for key in words if "." in key and key in shown.split()]


def test_a_printed_report_shows_the_hashes_that_are_folded_on_a_screen(
    browser: object, tmp_path: Path
) -> None:
    out = write_folder(tmp_path / "result")
    write_report(out, out / "report.html")
    page = browser.new_page()
    page.goto((out / "report.html").as_uri())
    for media, shown in (("screen", False), ("print", True)):
        page.emulate_media(media=media)
        digest = page.locator("#provenance code").first
        assert digest.evaluate("one => one.checkVisibility({contentVisibilityAuto: true})") is shown
