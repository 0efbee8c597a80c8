"""Time the page's API with many readers, its canvas with many bundles: `python benchmarks/page_readers.py`.

The server runs in a process of its own, `barsight serve` as a user starts it, on a store that the tests'
drawn yard fills. Open pages hold a stream of events while a live run's crane moves. Each reader asks for the
six documents in turn over a connection of its own, with a pause in between. The share of a core that the
server uses is what it takes from a measuring process beside it. The canvas is timed in Chromium where
Playwright is installed.
"""

from __future__ import annotations

import argparse
import http.client
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from live_folders import beating, live_folder
from page_yards import fill_store

DOCUMENTS = ("state", "bundles", "lifts", "surveys", "alarms", "stock")
PAN = """async (count) => {
  const view = barsightYard;
  const lay = (k) => {
    const x = 0.5 * (k % 200), y = 7 * Math.floor(k / 200);
    return { identity: `B${k}`, stock_name: null, ends_m: [[x, y], [x, y + 6]], ends_open: [false, false],
      axis_centre_m: [x, y + 3, 0.3], width_m: 0.3, top_z_m: 0.3 + (k % 7) / 10, doubt: null, lift: null,
      vetoes: k % 3 ? [{code: "end-open", reason: ""}] : [] };
  };
  const bundles = Array.from({ length: count }, (_, k) => lay(k));
  view.show({ ...view.data, bundles, lifts: [] }, null);
  view.fit();
  await new Promise((go) => setTimeout(go, 300));
  const told = [];
  for (const scale of [view.view.scale, 4 * view.view.scale]) {
    view.view.scale = scale;
    view.frames = [];
    const stamps = [];
    for (let k = 0; k < 60; k += 1) {
      view.pan(k < 30 ? 20 : -20, 3);
      stamps.push(await new Promise(requestAnimationFrame));
    }
    const sorted = view.frames.slice().sort((a, b) => a - b);
    told.push({ px_per_m: scale, frames_per_s: 59000 / (stamps[59] - stamps[0]),
      paint_ms_median: sorted[sorted.length >> 1], paint_ms_max: sorted[sorted.length - 1] });
  }
  return told;
}"""


def read(port: int, seconds: float, pause_s: float, times: list[float]) -> None:
    """Ask for the documents in turn until the time is over."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    end_s = time.perf_counter() + seconds
    k = 0
    while (began_s := time.perf_counter()) < end_s:
        connection.request("GET", f"/api/{DOCUMENTS[k % len(DOCUMENTS)]}")
        answer = connection.getresponse()
        answer.read()
        if answer.status != 200:
            raise SystemExit(f"{answer.status}")
        times.append(time.perf_counter() - began_s)
        k += 1
        time.sleep(pause_s)


def canvas(address: str, count: int) -> list[dict[str, float]] | None:
    """Pan over so many bundles in Chromium; None where it is not installed."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        return None
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1600, "height": 900})
        page.goto(address)
        page.wait_for_selector("#yard")
        page.wait_for_timeout(1000)
        found: list[dict[str, float]] = page.evaluate(PAN, count)
        browser.close()
    return found


def stream(port: int, over: threading.Event, counts: list[int]) -> None:
    """Hold a stream of events open as a page does, and count what comes."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    connection.request("GET", "/api/events")
    answer = connection.getresponse()
    count = 0
    while not over.is_set():
        count += answer.readline().startswith(b"event:")
    counts.append(count)
    connection.close()


def cpu_s(pid: int) -> float:
    """Read the seconds of all cores that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def share_of_core(pid: int, act: Callable[[], None]) -> float:
    """Run `act` and return the share of one core that the process used meanwhile."""
    began, began_s = cpu_s(pid), time.perf_counter()
    act()
    return (cpu_s(pid) - began) / (time.perf_counter() - began_s)


def run_threads(targets: list[Callable[[], None]]) -> None:
    """Run all at once until the last one ends."""
    threads = [threading.Thread(target=target) for target in targets]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def main() -> None:
    """Run and print JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--readers", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--pause-s", type=float, default=0.1)
    parser.add_argument("--bundles", type=int, default=10_000)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        url, live = fill_store(Path(folder)), live_folder(Path(folder) / "live", crane_m=[2.4, 1.1, 7.0])
        command = [sys.executable, "-m", "barsight", "serve", "--store", url, "--port", "0", "--live", live]
        with beating(live), subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
            assert server.stdout is not None
            address = server.stdout.readline().split()[0]
            try:
                told = measured(server.pid, address, live, given)
            finally:
                server.terminate()
    sys.stdout.write(json.dumps(told, indent=1) + "\n")


def measured(pid: int, address: str, live: Path, given: argparse.Namespace) -> dict[str, object]:
    """Measure the server at rest, with open pages while the crane moves and with readers, then the canvas."""
    port, times, counts = int(address.rsplit(":", 1)[1]), list[float](), list[int]()
    over = threading.Event()

    def travel() -> None:
        end_s, x_m = time.perf_counter() + given.seconds, 3.0
        while time.perf_counter() < end_s:
            x_m += 0.05
            live_folder(live, position_m=[x_m, 1.0, 8.0])
            time.sleep(0.05)
        over.set()

    rest = share_of_core(pid, lambda: time.sleep(given.seconds / 2))
    pages = [lambda: stream(port, over, counts)] * given.readers
    open_pages = share_of_core(pid, lambda: run_threads([travel, *pages]))
    readers = [lambda: read(port, given.seconds, given.pause_s, times)] * given.readers
    reading = share_of_core(pid, lambda: run_threads(readers))
    ms = 1e3 * np.array(times)
    return {
        "load_1_min": os.getloadavg()[0], "readers": given.readers, "requests": len(ms),
        "p50_ms": float(np.percentile(ms, 50)), "p99_ms": float(np.percentile(ms, 99)),
        "max_ms": float(ms.max()), "requests_per_s": len(ms) / given.seconds,
        "share_of_one_core": {"at rest": rest, "open pages": open_pages, "readers": reading},
        "events_a_page": sum(counts) / len(counts), "canvas": [
            {"bundles": count, "views": canvas(address, count)} for count in (10, given.bundles)
        ],
    }  # fmt: skip


if __name__ == "__main__":
    main()
