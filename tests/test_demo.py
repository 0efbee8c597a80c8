"""The demo: its page shows what changed, and nothing stands where its lifts are offered."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.simulate import stream
from barsight.simulation.stock import Stock, stack_yard
from barsight.yard.magnet.description import load_magnet

LONGER_M = 0.0375
"""Maximum length (m) by which single bars extend beyond their bundle."""


def test_the_demo_ends_on_the_page_with_a_change_and_a_stock_list(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "barsight", "demo"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as demo:
        assert demo.stdout is not None
        address = demo.stdout.readline().split()[0]
        with httpx.Client(base_url=address) as client:
            surveys = client.get("/api/surveys").json()["surveys"]
            later, first = (one["captured_to_ns"] for one in surveys)
            times = {"before_ns": first + 10**6, "after_ns": later + 10**6}
            changes = client.get("/api/compare", params=times).json()["changes"]
            stock = client.get("/api/stock").json()["differences"]
            state = client.get("/api/state").json()
        demo.send_signal(signal.SIGINT)
        assert demo.wait(30) == 0
    told = json.loads((tmp_path / "demo/recording_later/truth/changes.json").read_text())
    true = {one["kind"]: one["center"][:2] for one in told}
    found = {one["what"]: one["from_m"][:2] for one in changes if one["what"] != "came"}
    assert set(found) == {"went", "moved"} and set(true) == {"taken", "moved"}
    for what, kind in (("went", "taken"), ("moved", "moved")):
        assert found[what] == pytest.approx(true[kind], abs=0.1)
    assert "missing" in {one["kind"] for one in stock}
    assert state["survey"]["is_simulated"] and state["alarms"] >= 2
    offered = json.loads((tmp_path / "demo/result/lifts.json").read_text())["lifts"]
    assert len(offered) >= 3
    for lift in offered:
        assert -0.01 < true_rise_m(lift) < 0.015


def true_rise_m(lift: Any) -> float:
    """The highest steel or dunnage of the demo over the plane of the faces, under one of them or within the
    crane's tolerance of it, by its cylinders and boxes.
    """
    settings, magnet = SimulationSettings.demo(), load_magnet(None)
    stock, target = stack_yard(settings, stream(settings, 0)), lift["target"]
    yaw = np.radians(target["yaw_deg"])
    along, across = np.array([-np.sin(yaw), np.cos(yaw)]), np.array([np.cos(yaw), np.sin(yaw)])
    rise = -np.inf
    for pole in magnet.poles:
        half = np.array([pole.length_m, pole.width_m]) / 2
        half = (
            half + (magnet.tolerance.y_m, magnet.tolerance.x_m) + np.radians(magnet.tolerance.yaw_deg) * 2.6
        )
        v, u = np.meshgrid(*(np.arange(-h, h, 0.004) for h in half))
        v, u = (v + pole.along_m).ravel(), (u + pole.across_m).ravel()
        xy = (target["x_m"], target["y_m"]) + v[:, None] * along + u[:, None] * across
        plane = target["z_m"] + np.tan(np.radians(lift["pitch_deg"])) * v
        plane += np.tan(np.radians(lift["roll_deg"])) * u
        rise = max(rise, float((true_heights(stock, xy) - plane).max()))
    return rise


def true_heights(stock: Stock, xy: np.ndarray) -> np.ndarray:
    """Heights of bars and dunnage at places (N, 2)."""
    top = np.zeros(len(xy))
    for bundle in stock.bundles:
        sideways, along, _ = bundle.axes
        off = xy - bundle.centre_m[:2]
        inside = np.abs(off @ along[:2]) <= bundle.length_m / 2 + LONGER_M
        for aside, up in bundle.cross_m:
            under = (bundle.kind.diameter_m / 2) ** 2 - (off @ sideways[:2] - aside) ** 2
            height = bundle.centre_m[2] + up + np.sqrt(np.maximum(under, 0))
            top = np.maximum(top, np.where(inside & (under > 0), height, 0))
    for beam in stock.beams:
        c, s = np.cos(beam.yaw_rad), np.sin(beam.yaw_rad)
        local = (xy - beam.centre_m[:2]) @ np.array([[c, -s], [s, c]])
        inside = (np.abs(local) <= beam.half_m[:2]).all(axis=1)
        top = np.maximum(top, np.where(inside, beam.centre_m[2] + beam.half_m[2], 0))
    return top
