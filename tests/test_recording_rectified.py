"""Each pair is decoded and rectified once, however many read it."""

from __future__ import annotations

from collections.abc import Container, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.records.pairs import RectifiedPair, RefusedFrame, StereoFrame
from barsight.recording import rectified_pairs
from barsight.recording.rectified_pairs import RectifiedPairs
from motion_recordings import MemoryRecording, ideal_rig

RIG = ideal_rig(32, 24)


class CountedRecording(MemoryRecording):
    """Tells which frames were decoded."""

    def frames(self, wanted: Container[int] | None = None) -> Iterator[StereoFrame | RefusedFrame]:
        for frame in super().frames(wanted):
            DECODED.append(frame.stamp_ns)
            yield frame


DECODED: list[int] = []


@pytest.fixture
def recording() -> CountedRecording:
    DECODED.clear()
    rng = np.random.default_rng(0)
    frames: list[StereoFrame | RefusedFrame] = [
        StereoFrame(stamp, *rng.integers(0, 255, (2, 24, 32), np.uint8)) for stamp in range(10, 18)
    ]
    frames[3] = RefusedFrame(13, "torn")
    frames[5] = StereoFrame(15, np.zeros((9, 9), np.uint8), np.zeros((9, 9), np.uint8))
    return CountedRecording(RIG, tuple(frames))


def outcome(pairs: Iterator[RectifiedPair | RefusedFrame]) -> list[tuple[int, object]]:
    return [
        (one.stamp_ns, one.reason if isinstance(one, RefusedFrame) else (one.left.sum(), one.right.sum()))
        for one in pairs
    ]


def test_a_second_reader_decodes_nothing_that_was_rectified(
    recording: CountedRecording, tmp_path: Path
) -> None:
    pairs = RectifiedPairs(recording, Rectifier(RIG), tmp_path)
    first = outcome(pairs())
    assert [stamp for stamp, _ in first] == list(range(10, 18))
    assert first[3][1] == "torn" and "the left image is 9x9" in str(first[5][1])
    DECODED.clear()
    assert outcome(pairs({10, 13, 17})) == [first[0], first[3], first[7]]
    assert DECODED == [13]


def test_readers_side_by_side_get_the_same(recording: CountedRecording, tmp_path: Path) -> None:
    pairs = RectifiedPairs(recording, Rectifier(RIG), tmp_path)
    expected = outcome(RectifiedPairs(recording, Rectifier(RIG))())
    for _ in range(20):
        for file in tmp_path.iterdir():
            file.unlink()
        with ThreadPoolExecutor(2) as pool:
            readers = [pool.submit(lambda: outcome(pairs())) for _ in range(2)]
            assert [reader.result() for reader in readers] == [expected, expected]


def test_what_does_not_fit_on_disk_is_decoded_again(
    recording: CountedRecording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rectified_pairs, "MAX_STORED_BYTES", 3 * 2 * 24 * 32)
    pairs = RectifiedPairs(recording, Rectifier(RIG), tmp_path)
    first = outcome(pairs())
    assert len(list(tmp_path.iterdir())) == 3
    DECODED.clear()
    assert outcome(pairs()) == first
    assert DECODED == [13, 14, 15, 16, 17]
