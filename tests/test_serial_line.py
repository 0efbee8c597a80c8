"""Readings by a serial line: a pseudo terminal whose other end another process holds."""

import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest

import barsight as bs
from barsight.live.crane import preflight
from barsight.live.settings import CraneConfig, read_crane
from barsight.sensors.receiver import RawReading, ReadingReceiver
from barsight.sensors.settings import ReadingsSettings
from reading_forms import pack

RATE_HZ, FIRST = 200, 10_000
VALUES = (0.001, -0.002, 0.003, 0.1, 0.2, -9.8)
MARK = b"BSI1"


def stamp(number: int) -> int:
    """Tell the time of a clock that is far from any here."""
    return 7 * 10**17 + number * 5_000_000


def framed(number: int, sensor: str = "imu", values: tuple[float, ...] = VALUES) -> bytes:
    reading = pack(sensor, number, stamp(number), values)
    return reading + zlib.crc32(reading).to_bytes(4, "little")


class Line:
    """A device that another process plays, and what a receiver in a thread had from it."""

    def __init__(self, link: Path) -> None:
        self.link, self.found, self._going = link, list[RawReading](), True
        self.process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("serial_sender.py")), str(link), str(RATE_HZ)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self.process.stdout is not None and self.process.stdout.readline() == "plugged\n"
        self.settings = ReadingsSettings(device=str(link), baud=921600, rate_hz=RATE_HZ)
        self.receiver = ReadingReceiver("imu", self.settings)
        self._thread = threading.Thread(target=self._take)

    def _take(self) -> None:
        for one in self.receiver.readings(lambda: self._going, time.monotonic_ns):
            self.found.append(one)

    def begin(self) -> None:
        """Receive, and wait until something came; what comes before the line is open is lost."""
        self._thread.start()
        number = 0
        while not self.found:
            self.send([framed(number)])
            number += 1
            time.sleep(0.02)
        time.sleep(0.1)
        self.found.clear()
        self.send([framed(FIRST - 1)])
        self.until(lambda: bool(self.found))
        self.found.clear()

    def send(self, pieces: Iterable[bytes]) -> None:
        self.tell("".join(piece.hex() + "\n" for piece in pieces))

    def tell(self, text: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(text)
        self.process.stdin.flush()

    def until(self, is_so: Callable[[], bool], limit_s: float = 15.0) -> None:
        give_up = time.monotonic() + limit_s
        while not is_so():
            assert time.monotonic() < give_up, self.found[-3:]
            time.sleep(0.01)

    def numbers(self) -> list[int]:
        return [(one.device_ns - stamp(0)) // 5_000_000 for one in self.found]

    def close(self) -> None:
        self._going = False
        if self._thread.is_alive():
            self._thread.join(5.0)
        self.receiver.close()
        self.process.kill()  # it may wait for someone to read
        self.process.communicate()


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Line]:
    one = Line(tmp_path / "ttyIMU")
    yield one
    one.close()


def test_two_hundred_readings_a_second_come_whole_and_with_the_senders_stamps(line: Line) -> None:
    line.begin()
    torn, began = line.receiver.torn, time.monotonic()
    wanted = list(range(FIRST, FIRST + 3 * RATE_HZ))
    line.send(framed(number) for number in wanted)
    line.until(lambda: len(line.found) >= len(wanted))
    assert 2.5 < time.monotonic() - began < 6
    assert line.numbers() == wanted and line.receiver.torn == torn
    assert {one.lost for one in line.found} == {0} and {one.values for one in line.found} == {VALUES}
    assert (np.diff([one.arrival_ns for one in line.found]) >= 0).all()


@pytest.mark.parametrize("seed", range(5))
def test_a_reading_is_found_again_after_noise_and_lost_bytes(line: Line, seed: int) -> None:
    """Between whole readings: noise, a half one, a wrong bit, a false beginning, a long noise, no number."""
    rng = np.random.default_rng(seed)
    line.begin()
    before, n = line.receiver.torn, FIRST
    noise = rng.integers(0, 256, 150, np.uint8).tobytes().replace(b"B", b"b")
    wrong = bytearray(framed(n + 5))
    wrong[int(rng.integers(0, len(wrong)))] ^= 1 << int(rng.integers(0, 8))
    half = framed(n + 3)[: int(rng.integers(1, 67))]
    stream = framed(n) + noise[:10] + framed(n + 1) + framed(n + 2) + half + framed(n + 4) + wrong
    stream += framed(n + 6) + MARK + framed(n + 7) + noise + framed(n + 8)
    stream += (
        framed(n + 9, values=(*VALUES[:5], float("nan"))) + framed(n + 10) + framed(n + 10) + framed(n + 11)
    )
    cuts = np.sort(rng.integers(0, len(stream), 20)).tolist()
    line.send(stream[i:j] for i, j in zip([0, *cuts], [*cuts, len(stream)], strict=True))
    line.until(lambda: bool(line.found) and line.numbers()[-1] == n + 11)
    assert [number - n for number in line.numbers()] == [0, 1, 2, 4, 6, 7, 8, 10, 11]
    assert [one.lost for one in line.found] == [0, 0, 0, 1, 1, 0, 0, 1, 0]
    # 10 bytes, half, bit, mark; 150 bytes are three readings' begun lengths; NaN
    assert line.receiver.torn - before == 1 + 1 + 1 + 1 + 3 + 1


def test_an_unplugged_device_is_opened_anew_until_it_is_back(line: Line) -> None:
    line.begin()
    torn, n = line.receiver.torn, FIRST
    line.send([*map(framed, range(n, n + 20)), framed(n + 20)[:30]])
    line.until(lambda: len(line.found) == 20)
    line.tell("unplug 2.5\n")
    line.until(lambda: line.receiver.trouble == "No such file or directory")
    line.send(map(framed, range(n + 50, n + 450)))
    line.until(lambda: line.numbers()[-1] == n + 449)
    back = line.found[20]
    assert line.numbers()[20] > n + 49 and back.lost == line.numbers()[20] - n - 20
    assert all(one.lost == 0 for one in line.found[21:]) and line.receiver.trouble == ""
    assert line.numbers()[20:] == list(range(line.numbers()[20], n + 450))
    line.tell("unplug 0.1\n")  # and it counts from 0 on
    line.send(map(framed, range(400)))
    line.until(lambda: line.numbers()[-1] == 399)
    fresh = line.numbers().index(n + 449) + 1
    assert line.found[fresh].lost == 0 and line.receiver.torn == torn


def described(crane_toml: Path, imu: str, whole: Path) -> CraneConfig:
    from barsight.calibration.files.rig_file import write_rig_file

    write_rig_file(crane_toml.with_name("rig.yaml"), bs.open_recording(whole).rig)
    crane_toml.write_text(
        f'calibration = "rig.yaml"\n[cameras]\nserials = ["A1", "B2"]\nrate_hz = 30\n[imu]\n{imu}\n'
    )
    return read_crane(crane_toml)


@pytest.mark.parametrize(
    ("imu", "words"),
    [
        ("rate_hz = 200", "neither is given; give the UDP port or the serial line"),
        ('rate_hz = 200\nport = 5601\ndevice = "/dev/ttyS0"\nbaud = 115200', "both are given"),
        ('rate_hz = 200\ndevice = "/dev/ttyS0"', "imu.device and imu.baud belong together"),
        ("rate_hz = 200\nport = 5601\nbaud = 115200", "imu.device and imu.baud belong together"),
        ('rate_hz = 200\ndevice = "/dev/ttyS0"\nbaud = 115000', "imu.baud is 115000; choose 9600"),
        ('rate_hz = 200\ndevice = "/dev/ttyS0"\nbaud = 115200', "give over 136000, or a lower imu.rate_hz"),
        ("device = 5\nbaud = 921600\nrate_hz = 200", "imu.device is 5; give text in quotes"),
    ],
)
def test_one_way_must_be_named_and_be_fast_enough(imu: str, words: str, whole: Path, tmp_path: Path) -> None:
    with pytest.raises(bs.BarsightError) as error:
        described(tmp_path / "crane.toml", imu, whole)
    assert words in str(error.value) and "\n" not in str(error.value) and error.value.exit_code == 2


def serial(device: Path) -> str:
    return f'device = "{device}"\nbaud = 921600\nrate_hz = {RATE_HZ}'


def test_a_serial_line_is_proved_before_a_run(line: Line, whole: Path, tmp_path: Path) -> None:
    crane = described(tmp_path / "crane.toml", serial(line.link), whole)
    rig = crane.described(tmp_path / "out")
    line.send(framed(number) for number in range(10 * RATE_HZ))
    heard = preflight.prove_sensor(crane, rig, "imu").imu_samples
    assert heard is not None and len(heard.stamp_ns) == RATE_HZ // 2
    assert np.allclose(heard.accel_mps2, VALUES[3:]) and heard.stamp_ns[0] >= stamp(0)


@pytest.mark.parametrize(
    ("device", "sensor", "words"),
    [
        ("nosuch", "", "(No such file or directory); check the sender"),
        ("crane.toml", "", "(Inappropriate ioctl for device); check the sender"),
        ("ttyIMU", "", "within 0.8 s; check the sender"),
        ("ttyIMU", "crane", " of another form; check the sender"),
    ],
)
def test_a_line_that_gives_nothing_is_refused_by_name(
    line: Line, device: str, sensor: str, words: str, whole: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(preflight, "LISTEN_S", 0.8)
    crane = described(tmp_path / "crane.toml", serial(tmp_path / device), whole)
    if sensor:
        line.send(framed(number, sensor, VALUES[:3]) for number in range(300))
    with pytest.raises(bs.BarsightError) as error:
        preflight.prove_sensor(crane, crane.described(tmp_path / "out"), "imu")
    told = str(error.value)
    assert told.startswith(f"imu: 0 readings came to {tmp_path / device} at 921600 baud within 0.8 s")
    assert words in told and "\n" not in told and "the cable, the baud and the rights" in told
