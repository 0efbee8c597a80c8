"""Pair left and right pictures by stamp, and decode stored pictures for their camera."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from barsight.calibration.geometry.camera import Camera
from barsight.core.arrays import Int64, UInt8
from barsight.core.errors import InputError
from barsight.core.records.pairs import RefusedFrame
from barsight.core.stamps import Pairing, pair_stamps, seconds_to_ns
from barsight.recording.base import FrameIndex
from barsight.recording.image_decoding import decode_gray


@dataclass(frozen=True, eq=False)
class PairedStamps:
    """left_ns, right_ns: all stamps of the two cameras. pairing: indices into them. index: for the stages."""

    left_ns: Int64
    right_ns: Int64
    pairing: Pairing
    index: FrameIndex


class PairedAtOpening:
    """Index of a `Recording` whose reader pairs the stamps when it opens, as `_pairs`."""

    _pairs: PairedStamps

    @property
    def index(self) -> FrameIndex:
        """Return the index; see `Recording.index`."""
        return self._pairs.index

    @property
    def camera_stamps(self) -> PairedStamps:
        """Return all stamps of both cameras, paired or not."""
        return self._pairs


def pair_cameras(path: Path, left_ns: Int64, right_ns: Int64, tolerance_s: float) -> PairedStamps:
    """Pair two cameras' stamps. Raises `InputError` about `path` if not a single pair is found."""
    for name, stamps_ns in (("cam0", left_ns), ("cam1", right_ns)):
        if stamps_ns.size == 0:
            raise InputError(path, f"holds no picture of {name}", "copy the recording again")
    pairing = pair_stamps(left_ns, right_ns, seconds_to_ns(tolerance_s))
    if pairing.left.size == 0:
        nearest = np.abs(left_ns[:, None][:1000] - right_ns[None, :1000]).min() / 1e6
        raise InputError(
            path,
            f"no left picture has a right one within {tolerance_s * 1e3:g} ms (the nearest is {nearest:g} ms "
            "away)",
            "raise the pair tolerance if the clocks drift, else check that both folders are of one recording",
        )
    limit = f"within {tolerance_s * 1e3:g} ms"
    left_only = [(int(left_ns[k]), f"cam0 only: no picture of cam1 {limit}") for k in pairing.left_only]
    right_only = [(int(right_ns[k]), f"cam1 only: no picture of cam0 {limit}") for k in pairing.right_only]
    unpaired = tuple(RefusedFrame(stamp, reason) for stamp, reason in sorted(left_only + right_only))
    stamps = tuple(int(stamp) for stamp in left_ns[pairing.left])
    return PairedStamps(left_ns, right_ns, pairing, FrameIndex(stamps, unpaired))


def decode_for(camera: Camera, data: bytes) -> UInt8:
    """Decode a stored picture; also raises `TornImageError` if it does not have the calibration's size."""
    return decode_gray(data, (camera.width, camera.height))
