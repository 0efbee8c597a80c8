"""Choose the camera driver named in crane.toml, and check cameras with it."""

from __future__ import annotations

from barsight.core.errors import InputError
from barsight.sensors.camera import CameraDriver
from barsight.sensors.settings import CamerasSettings


def both_cameras(settings: CamerasSettings, size: tuple[int, int]) -> tuple[CameraDriver, CameraDriver]:
    """Make cam0 and cam1, not connected yet. size: width and height of the calibration.

    Raises ConfigError if the driver isn't installed.
    """
    driver = _driver(settings)
    return driver(0, settings, size), driver(1, settings, size)


def prove_cameras(settings: CamerasSettings, size: tuple[int, int]) -> tuple[str, str]:
    """Check that cam0 and cam1 are present and can be configured; return their PTP states.

    size: width and height of the calibration. Raises InputError for a camera that is absent, in use, or does
    not fit its calibration.
    """
    cameras = both_cameras(settings, size)
    found = cameras[0].find(settings)
    for camera in cameras:
        if camera.serial not in found:
            there = ", ".join(sorted(found)) or "none"
            raise InputError(
                camera.name, f"no camera of serial number {camera.serial} answers (there: {there})",
                "check its power and cable, and cameras.serials in crane.toml",
            )  # fmt: skip
    told = []
    for camera in cameras:
        camera.open(found[camera.serial])
        told.append(camera.ptp)
        camera.close()
    return told[0], told[1]


def _driver(settings: CamerasSettings) -> type[CameraDriver]:
    """Import the driver, an extra that replays don't need."""
    if settings.driver == "pylon":
        from barsight.sensors.pylon import PylonCamera

        return PylonCamera
    from barsight.sensors.gige import GigeCamera

    return GigeCamera
