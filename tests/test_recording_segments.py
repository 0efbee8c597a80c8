"""Segments of a live recording: all of it back, up to where a kill cut it off."""

import resource
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

import barsight as bs
from barsight.core.records.pairs import StereoFrame
from barsight.core.records.sensor_samples import ImuSamples
from barsight.recording.base import Recording
from barsight.recording.formats.segments import SegmentFile, segments_of
from barsight.recording.writers.bag import write_descriptions
from barsight.recording.writers.segments import SegmentWriter


def write(recording: Recording, folder: Path, segment_bytes: int) -> int:
    """Write a recording as a live run does; returns the bytes of the last segment before it was ended."""
    writer = SegmentWriter(folder, segment_bytes)
    write_descriptions(recording, folder)
    imu, crane = recording.imu(), recording.crane()
    assert imu is not None and crane is not None
    writer.samples(crane)
    for frame in recording.frames():
        assert isinstance(frame, StereoFrame)
        writer.pair(frame.stamp_ns, frame.left, frame.right)
    writer.samples(imu)
    size = segments_of(folder)[-1].stat().st_size
    writer.close()
    return size


def test_segments_give_the_recording_back(whole: Path, tmp_path: Path) -> None:
    wanted = bs.open_recording(whole)
    write(wanted, tmp_path, 300_000)
    found = bs.open_recording(tmp_path)
    assert len(segments_of(tmp_path)) > 1 and found.format == "segments"
    for one, other in zip(wanted.frames(), found.frames(), strict=True):
        assert isinstance(one, StereoFrame) and isinstance(other, StereoFrame)
        assert one.stamp_ns == other.stamp_ns
        assert np.array_equal(one.left, other.left) and np.array_equal(one.right, other.right)
    for sensor in ("imu", "crane"):
        one, other = (getattr(recording, sensor)() for recording in (wanted, found))
        for name, value in vars(one).items():
            assert np.array_equal(value, getattr(other, name)), name
    assert found.rig.baseline_m == wanted.rig.baseline_m and found.imu_noise() == wanted.imu_noise()
    with AnyReader(segments_of(tmp_path)[:1]) as reader:  # others read whole segments too
        assert sum(1 for _ in reader.messages()) > 0


@pytest.mark.parametrize("cut", [1, 37, 60, 150, 5000])
def test_a_torn_segment_is_read_up_to_the_tear_and_taken_up(whole: Path, tmp_path: Path, cut: int) -> None:
    wanted = bs.open_recording(whole)
    size = write(wanted, tmp_path, 1 << 30)
    (path,) = segments_of(tmp_path)
    imu = wanted.imu()
    assert imu is not None
    path.write_bytes(path.read_bytes()[: size - cut])
    torn = bs.open_recording(tmp_path).imu()
    assert torn is not None
    count = len(torn.stamp_ns)
    lost = len(imu.stamp_ns) - count
    assert 0 < lost <= cut // 300 + 1 and np.array_equal(torn.accel_mps2, imu.accel_mps2[:count])
    again = SegmentWriter(tmp_path)
    again.samples(imu)
    again.close()
    mended = bs.open_recording(tmp_path).imu()
    assert mended is not None and np.array_equal(mended.stamp_ns, imu.stamp_ns)


def bytes_read() -> int:
    return int(Path("/proc/self/io").read_text(encoding="ascii").split()[1])


def test_a_recorder_begun_anew_reads_no_pictures_again(tmp_path: Path) -> None:
    # A shift's recording is tens of GB: read whole, the recorder didn't go on for minutes and was ended.
    image = np.zeros((1000, 2000), np.uint8)
    writer = SegmentWriter(tmp_path, 10_000_000)
    for stamp in range(1, 11):
        writer.pair(stamp, image, image)
    writer.close()
    before = bytes_read()
    again = SegmentWriter(tmp_path)
    assert again.last_pair_ns == 10 and bytes_read() - before < 2_000_000


def test_what_a_full_disk_cut_off_spoils_nothing_that_follows(whole: Path, tmp_path: Path) -> None:
    # The system writes what there is room for and tells how much; then retention makes room again.
    imu = bs.open_recording(whole).imu()
    assert imu is not None
    most, limits = 50_000, resource.getrlimit(resource.RLIMIT_FSIZE)
    writer = SegmentWriter(tmp_path)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, limits[1]))
    try:
        for k in range(len(imu.stamp_ns)):
            one = ImuSamples(*(values[k : k + 1] for values in vars(imu).values()))
            try:
                writer.samples(one)
            except OSError:
                resource.setrlimit(resource.RLIMIT_FSIZE, limits)
                writer.samples(one)
            if segments_of(tmp_path)[-1].stat().st_size == most:
                resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    writer.close()
    assert [one.stamp_ns for one in SegmentFile(tmp_path).messages(["/imu0"])] == imu.stamp_ns.tolist()


def test_what_is_no_mcap_is_refused(tmp_path: Path) -> None:
    (tmp_path / "segment_000001.mcap").write_bytes(b"nothing of the kind")
    with pytest.raises(bs.BarsightError, match=r"segment_000001\.mcap: is not an MCAP file"):
        bs.open_recording(tmp_path)
