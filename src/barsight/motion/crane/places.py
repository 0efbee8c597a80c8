"""Choose the frames, and the stamps between them, that encoders place."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Int64
from barsight.core.errors import Failed, MeasurementError
from barsight.core.records.pairs import RefusedFrame
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.stamps import seconds_to_ns
from barsight.motion.crane.encoder_trajectory import fit_position
from barsight.recording.base import Recording

PLACE_SPACING_S = 0.4


def place_spacing_ns(crane: CraneSamples) -> int:
    """Return the interval of encoder positions: each reading counts for one of them."""
    return max(seconds_to_ns(PLACE_SPACING_S), 2 * crane.reach_ns(0))


def placed_frames(
    recording: Recording, crane: CraneSamples, sighted: Int64, shift: int
) -> tuple[Int64, list[RefusedFrame]]:
    """List the stamps of all frames that encoders or pictures place, and the refused frames. Raises
    MeasurementError where the pictures place some and the encoders none: nothing then ties them to the yard.
    """
    known, failed = set(sighted.tolist()), dict[int, Failed]()
    stamps_ns = recording.index.stamps_ns
    for stamp in stamps_ns:
        fit = fit_position(crane, stamp + shift, seconds_to_ns(0.35))
        if isinstance(fit, Failed):
            failed[stamp] = fit
    refused = [RefusedFrame(stamp, fit.reason) for stamp, fit in failed.items() if stamp not in known]
    if known and len(failed) == len(stamps_ns):
        reason = failed[stamps_ns[0]].reason
        raise MeasurementError(
            f"{recording.path}: the encoders place no frame ({reason}); give more readings on the pictures' "
            "clock, or measure without them (use: stereo,imu)"
        )
    frames = [stamp for stamp in stamps_ns if stamp not in failed or stamp in known]
    return np.array(frames, np.int64), refused


def indices_apart(stamp_ns: Int64, min_ns: int) -> list[int]:
    """Select indices of stamps at least about `min_ns` apart, starting with the first."""
    chosen = [0]
    for k in range(1, len(stamp_ns)):
        if stamp_ns[k] - stamp_ns[chosen[-1]] >= 0.97 * min_ns:
            chosen.append(k)
    return chosen
