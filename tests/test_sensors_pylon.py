"""Basler cameras, against those that pylon plays itself, which have no clock."""

import time
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import barsight as bs
from barsight.core.errors import InputError
from barsight.live.crane.check import check_machine
from barsight.live.settings import read_crane
from barsight.sensors.camera import Blocks, RawLoss, RawPicture
from barsight.sensors.drivers import prove_cameras
from barsight.sensors.settings import CamerasSettings
from test_sensors import GOOD

SERIALS = "0815-0000", "0815-0001"
SIZE = 320, 256
HZ = 100.0
SETTINGS = CamerasSettings(SERIALS, HZ, driver="pylon")


def test_blocks_are_counted_over_their_wrap_and_losses_told_by_cause() -> None:
    blocks = Blocks()
    gaps = [blocks.gap(number) for number in (65533, 65535, 1, 4, 4, 65536, 65540)]
    assert gaps[:4] == [0, 1, 0, 2] and blocks.gap(65541) == 0
    before = blocks.trigger
    assert gaps[6] == 3 and blocks.gap(65544) == 2 and blocks.trigger == before + 3
    told = [*blocks.losses(5, {"incomplete": 2, "backpressure": 1})]
    assert told == [RawLoss("incomplete", 2), RawLoss("backpressure", 1), RawLoss("missed", 2)]
    assert [*blocks.losses(1, {"incomplete": 4, "backpressure": 1})] == [RawLoss("incomplete", 1)]
    assert [*blocks.losses(1, {"incomplete": 4, "backpressure": 1})] == [RawLoss("missed", 1)]


def test_a_driver_that_is_not_there_is_refused_by_name(whole: Path, tmp_path: Path) -> None:
    text = GOOD.replace("[encoders]", 'driver = "basler"\n[encoders]')
    (tmp_path / "crane.toml").write_text(text)
    with pytest.raises(bs.BarsightError, match=r"cameras\.driver") as error:
        read_crane(tmp_path / "crane.toml")
    assert "gige" in str(error.value) and "pylon" in str(error.value)


@pytest.mark.skipif(find_spec("pypylon") is not None, reason="pypylon is installed")
def test_a_driver_that_is_not_installed_names_its_extra() -> None:
    with pytest.raises(bs.BarsightError, match=r"pip install 'barsight\[basler\]'"):
        prove_cameras(SETTINGS, SIZE)


@pytest.fixture
def emulated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have pylon play two cameras."""
    monkeypatch.setenv("PYLON_CAMEMU", "2")
    pytest.importorskip("pypylon.pylon", reason="pypylon isn't installed (extra basler)")


def timed(number: int, settings: CamerasSettings = SETTINGS, **nodes: Any) -> Any:
    """A camera whose missing clock is overlooked, and whose nodes are set as it is connected."""
    from barsight.sensors.pylon import PylonCamera

    class Timed(PylonCamera):
        def _expect(self, width: int, height: int, pixels: str) -> None:
            for name, value in ({"Width": SIZE[0], "Height": SIZE[1]} | nodes).items():
                self._nodes.GetNode(name).Value = value
            camera = self._camera
            super()._expect(camera.Width.Value, camera.Height.Value, camera.PixelFormat.Value)

        def _find_ticks(self) -> int:
            return 125_000_000

    return Timed(number, settings, SIZE)


def opened(camera: Any) -> Any:
    camera.open(camera.find(camera._settings)[camera.serial])
    return camera._nodes


def test_a_camera_without_stamps_of_exposure_is_refused_by_name(
    emulated: None, whole: Path, tmp_path: Path
) -> None:
    with pytest.raises(InputError) as error:
        prove_cameras(SETTINGS, (1024, 1040))
    words = "cam0: the camera 0815-0000 gives no stamps of exposure; use one with a clock"
    assert str(error.value).startswith(words) and "\n" not in str(error.value)
    with pytest.raises(InputError, match="cam0: the camera 0815-0000 gives 1024x1040, the calibration is"):
        prove_cameras(SETTINGS, SIZE)
    with pytest.raises(InputError, match=r"cam1: no camera of serial number X answers \(there: 0815-0000"):
        prove_cameras(replace(SETTINGS, serials=(SERIALS[0], "X")), SIZE)


@pytest.mark.parametrize(
    ("changes", "pixels", "words"),
    [
        ({}, "Mono12", "cam1: the camera 0815-0001 gives Mono12; set it to Mono8"),
        ({"trigger": "Line9"}, "Mono8", "cam1: the camera 0815-0001 refuses: Feature 'TriggerSource'"),
    ],
)
def test_what_a_camera_cannot_do_is_refused_by_name(
    changes: dict[str, Any], pixels: str, words: str, emulated: None
) -> None:
    camera = timed(1, replace(SETTINGS, **changes), PixelFormat=pixels)
    with pytest.raises(InputError) as error:
        opened(camera)
    assert str(error.value).startswith(words) and "\n" not in str(error.value)
    assert camera._camera is None


def test_the_camera_is_set_as_crane_toml_says(emulated: None) -> None:
    camera = timed(0, replace(SETTINGS, exposure_us=800, trigger="Line2", packet_size_bytes=1400))
    found = opened(camera)
    wanted = {
        "ExposureTime": 800.0, "TriggerSelector": "FrameStart", "TriggerSource": "Line2", "TriggerMode": "On",
        "AcquisitionMode": "Continuous", "GevSCPSPacketSize": 1428,
    }  # fmt: skip
    assert {name: found.GetNode(name).Value for name in wanted} == wanted
    camera.close()
    camera = timed(0, TriggerMode="On", TriggerSource="Line1")
    found = opened(camera)
    assert found.GetNode("TriggerMode").Value == "On", "free leaves the camera's own setting"
    assert found.GetNode("AcquisitionFrameRate").Value == HZ
    camera.close()


def test_pictures_of_both_come_whole_and_failed_grabs_are_counted(emulated: None) -> None:
    for number in (0, 1):
        camera = timed(number)
        pictures: list[RawPicture] = []
        losses: list[tuple[int, RawLoss]] = []
        give_up = time.monotonic() + 20
        began_ns = time.monotonic_ns()
        for item in camera.pictures(lambda: len(pictures) < 30 and time.monotonic() < give_up):  # noqa: B023
            if isinstance(item, RawLoss):
                losses.append((len(pictures), item))
                continue
            pictures.append(item)
            if len(pictures) in (5, 15):
                camera._nodes.GetNode("ForceFailedBufferCount").Value = 2 if len(pictures) == 5 else 1
                camera._nodes.GetNode("ForceFailedBuffer").Execute()
        took_s = (time.monotonic_ns() - began_ns) / 1e9
        assert camera.connects == 1 and camera._camera is None
        assert {picture.image.shape for picture in pictures} == {(SIZE[1], SIZE[0])}
        assert {picture.image.dtype for picture in pictures} == {np.dtype(np.uint8)}
        assert len({picture.image.tobytes() for picture in pictures}) > 5, "the test picture moves"
        assert [loss for _, loss in losses] == [RawLoss("incomplete", 2), RawLoss("incomplete", 1)]
        steps = np.diff([picture.trigger for picture in pictures])
        for (at, loss), step in zip(losses, steps[steps > 1], strict=True):
            assert step == loss.count + 1 and steps[at - 1] == step
        assert pictures[0].trigger == 1 and pictures[-1].trigger == 33
        assert {picture.device_ns for picture in pictures} == {0}, "never a stamp of arrival"
        assert took_s > 0.8 * 33 / HZ


def test_a_camera_that_nothing_triggers_is_waited_for_and_a_lost_one_connected_anew(
    emulated: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = timed(0, TriggerMode="On", TriggerSource="Software")
    waited = time.monotonic() + 1.0
    assert [*camera.pictures(lambda: time.monotonic() < waited)] == [] and camera.connects == 1
    camera = timed(0)
    there = camera.find(SETTINGS)
    searches = iter([there, {}, there])
    monkeypatch.setattr(camera, "find", lambda _: next(searches))
    give_up = time.monotonic() + 30
    triggers: list[int] = []
    for item in camera.pictures(lambda: len(triggers) < 20 and time.monotonic() < give_up):
        assert isinstance(item, RawPicture)
        triggers.append(item.trigger)
        if len(triggers) == 10:
            camera._camera.Close()
    assert triggers == [*range(1, 11), *range(1, 11)] and camera.connects == 2


def test_a_camera_that_is_removed_ends_its_stream(emulated: None) -> None:
    """Pylon tells that a device is gone; its emulated ones can't be unplugged, so it is told for it."""
    camera = timed(0, TriggerMode="On", TriggerSource="Software")
    opened(camera)
    held, began = camera._camera, time.monotonic()

    class Removed:
        def __getattr__(self, name: str) -> Any:
            return (lambda: True) if name == "IsCameraDeviceRemoved" else getattr(held, name)

    camera._camera = Removed()
    going_on = lambda: time.monotonic() - began < 5.0  # noqa: E731
    assert [*camera._stream(going_on)] == [] and going_on()
    camera.close()


def test_the_machines_check_names_what_the_cameras_lack(emulated: None, whole: Path, tmp_path: Path) -> None:
    from barsight.calibration.files.rig_file import write_rig_file

    write_rig_file(tmp_path / "rig.yaml", bs.open_recording(whole).rig)
    text = GOOD.replace('"A1", "B2"', '"0815-0000", "0815-0001"')
    (tmp_path / "crane.toml").write_text(text.replace("[encoders]", 'driver = "pylon"\n[encoders]'))
    found = {one.what: one for one in check_machine(read_crane(tmp_path / "crane.toml"), tmp_path / "out")}
    assert found["cameras"].passed is False and "0815-0000 gives 1024x1040" in found["cameras"].found
