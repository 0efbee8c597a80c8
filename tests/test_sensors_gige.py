"""Stamps of GigE Vision cameras."""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barsight.core.errors import InputError
from barsight.sensors.camera import RawPicture
from barsight.sensors.settings import CamerasSettings

vg = pytest.importorskip("viva_genicam", reason="viva-genicam is not installed (extra: cameras)")
SETTINGS = CamerasSettings(("L", "R"), 30.0)
PERIOD_S = 0.04


class Ticking:
    """A camera whose clock has `ticks` a second, which its feature or else its register reports."""

    def __init__(self, ticks: int, *, has_feature: bool) -> None:
        self.ticks, self.has_feature, self.control_state = ticks, has_feature, vg.ControlState.HELD

    def get_integer(self, name: str) -> int:
        if not self.has_feature:
            raise vg.GenApiError(f"node not found: {name}")
        return self.ticks

    def read_register(self, address: int, length: int) -> bytes:
        assert (address, length) == (0x093C, 8)
        return (0 if self.has_feature else self.ticks).to_bytes(8, "big")

    @contextmanager
    def stream(self, packet_size: int) -> Iterator[Any]:
        frames = (
            SimpleNamespace(
                block_id=k, ts_dev=round(k * PERIOD_S * self.ticks),
                to_numpy=lambda: np.zeros((4, 6), np.uint8),
            )
            for k in range(1, 100)
        )  # fmt: skip
        yield SimpleNamespace(next_frame=lambda wait_ms: next(frames))


@pytest.mark.parametrize(("ticks", "has_feature"), [(125_000_000, True), (66_666_667, False), (10**9, False)])
def test_stamps_are_ns_whatever_the_cameras_tick_is(ticks: int, has_feature: bool) -> None:
    from barsight.sensors.gige import GigeCamera

    camera = GigeCamera(0, SETTINGS, (6, 4))
    camera._camera = Ticking(ticks, has_feature=has_feature)
    camera._tick_hz = camera._find_ticks()
    found = list(islice(camera._stream(lambda: True), 20))
    stamps = [one.device_ns for one in found if isinstance(one, RawPicture)]
    assert np.abs(np.diff(stamps) - PERIOD_S * 1e9).max() < 100


def test_an_interface_that_is_not_there_is_named() -> None:
    from barsight.sensors.gige import GigeCamera

    with pytest.raises(InputError, match=r"cameras: can't be searched: iface 'nosuch0'.*cameras\.interface"):
        GigeCamera.find(CamerasSettings(("L", "R"), 30.0, interface="nosuch0"))


def test_a_camera_tells_why_it_is_not_connected_until_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is away, then comes back with another size, then as it was."""
    from barsight.sensors.gige import GigeCamera

    monkeypatch.setattr("barsight.sensors.camera.AGAIN_S", 0.0)
    camera, told = GigeCamera(1, SETTINGS, (6, 4)), []
    found: Iterator[dict[str, Any]] = iter([{}, {"R": (8, 4)}, {"R": (6, 4)}])

    def control(size: tuple[int, int]) -> None:
        told.append(camera.trouble)
        camera._expect(*size, "Mono8")

    monkeypatch.setattr(camera, "find", lambda settings: next(found))
    monkeypatch.setattr(camera, "_control", control)
    monkeypatch.setattr(camera, "_stream", lambda may_go_on: iter([camera.trouble]))
    told.append(str(next(camera.pictures(lambda: True))))
    assert told[0] == "does not answer" and told[2] == ""
    assert told[1].startswith("the camera R gives 8x4, the calibration is for 6x4; name the calibration")


def test_a_camera_without_a_clock_is_refused() -> None:
    from barsight.sensors.gige import GigeCamera

    camera = GigeCamera(1, SETTINGS, (6, 4))
    camera._camera = Ticking(0, has_feature=False)
    with pytest.raises(InputError, match="cam1: the camera R gives no stamps of exposure"):
        camera._find_ticks()
