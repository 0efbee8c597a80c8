"""Check that a machine can run live at a crane: cores, memory, disk, network, cameras, readings, clocks."""

from __future__ import annotations

import ctypes
import os
import shutil
import socket
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from barsight.calibration.files.rig_file import read_serials
from barsight.core.errors import BarsightError
from barsight.live.crane.preflight import expect_plausible, prove_sensor
from barsight.live.settings import CraneConfig
from barsight.sensors.camera import are_one_clock
from barsight.sensors.drivers import prove_cameras

MIN_CORES, MIN_MEMORY_GIB = 2, 2.0
KEYFRAME_BYTES_PER_PIXEL = 16
"""Disk space per pixel of a kept pair with its disparity until it is measured: 20 MB at 1.3 megapixels."""
SURVEY_M, TRAVEL_MPS = 50.0, 1.0
"""Length (m) and speed (m/s) of a survey whose pairs the disk must be able to store."""
WRITTEN_MIB = 64
HEADERS_BYTES = 28
"""Size of the IPv4 and UDP headers within a packet."""
UNSYNCHRONISED = 0x40
"""Status bit of adjtimex for a clock that isn't synchronised."""


@dataclass(frozen=True)
class Finding:
    """A line of the check. passed: None if the system doesn't say, or if a run can do without it."""

    what: str
    found: str
    needed: str
    remedy: str
    passed: bool | None


def check_machine(crane: CraneConfig, out: Path) -> Iterator[Finding]:
    """Yield the findings one by one. out: output folder of the runs; it or one of its parents exists."""
    yield _cores()
    yield _memory()
    yield _shared_memory(crane)
    places = {"runs": out.absolute()}
    if crane.recorder.folder is not None:
        places["recordings"] = crane.recorder.folder
    for name, folder in places.items():
        yield from _disk(name, folder, crane, is_run=name == "runs")
    yield _serials(crane)
    yield from _network(crane)
    yield from _sensors(crane)
    yield _clock()


def _cores() -> Finding:
    cores = len(os.sched_getaffinity(0))
    return Finding("cores", str(cores), f"{MIN_CORES}", "give the run more cores", cores >= MIN_CORES)


def _memory() -> Finding:
    """Read how much memory is available."""
    free = 0.0
    for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
        if line.startswith("MemAvailable:"):
            free = int(line.split()[1]) / 2**20
    needed = f"{MIN_MEMORY_GIB:g} GiB available"
    return Finding("memory", f"{free:.1f} GiB", needed, "end other programs", free >= MIN_MEMORY_GIB)


def _shared_memory(crane: CraneConfig) -> Finding:
    """Check that there is room for the ring of pairs."""
    camera = crane.rig().cam0
    needed = 2 * camera.width * camera.height * crane.live.ring_pairs
    free = shutil.disk_usage("/dev/shm").free
    return Finding(
        "shared memory", f"{free / 2**20:.0f} MiB free", f"{needed / 2**20:.0f} MiB for the ring of pairs",
        "enlarge /dev/shm (a container: --shm-size) or lower live.ring_pairs", free > needed,
    )  # fmt: skip


def _disk(name: str, folder: Path, crane: CraneConfig, *, is_run: bool) -> Iterator[Finding]:
    """Check free space and write speed for a run's pairs, or for its recording alone."""
    existing = next(path for path in (folder, *folder.parents) if path.is_dir())
    camera = crane.rig().cam0
    kept = camera.width * camera.height * (KEYFRAME_BYTES_PER_PIXEL if is_run else 2)
    way_m = crane.live.keyframe_way_m or TRAVEL_MPS / crane.cameras.rate_hz  # 0: each pair is a keyframe
    free, needed = shutil.disk_usage(existing).free, kept * SURVEY_M / way_m
    remedy = "free some, or name a folder on a larger disk"
    yield Finding(
        f"disk for {name} ({existing})", f"{free / 2**30:.1f} GiB free",
        f"{needed / 2**30:.1f} GiB for {SURVEY_M:g} m", remedy, free >= needed,
    )  # fmt: skip
    rate = kept * min(TRAVEL_MPS / way_m, crane.cameras.rate_hz) / 2**20
    needed_text = f"{rate:.0f} MiB/s at {TRAVEL_MPS:g} m/s"
    try:
        speed = write_speed_mib(existing)
    except OSError as error:
        yield Finding(f"writing {name}", error.strerror or str(error), needed_text, "make it writable", False)
        return
    yield Finding(
        f"writing {name}", f"{speed:.0f} MiB/s", needed_text, "use a faster disk, as an SSD", speed >= rate
    )


def write_speed_mib(folder: Path) -> float:
    """Measure how fast a file is written to the disk, MiB/s. Raises OSError if no file can be written."""
    block = os.urandom(1 << 20)
    with tempfile.NamedTemporaryFile(dir=folder, prefix=".barsight.") as file:
        began = time.perf_counter()
        for _ in range(WRITTEN_MIB):
            file.write(block)
        file.flush()
        os.fsync(file.fileno())
        return WRITTEN_MIB / (time.perf_counter() - began)


def _serials(crane: CraneConfig) -> Finding:
    """Check that exchanged cameras or the calibration of another rig would be noticed."""
    known = [serial or "none" for serial in read_serials(crane.calibration)]
    remedy = (
        f"put serial: under cam0 and cam1 of {crane.calibration.name}: else exchanged cameras aren't noticed"
    )
    passed = True if "none" not in known else None
    return Finding("serial numbers in the calibration", ", ".join(known), "both", remedy, passed)


def _network(crane: CraneConfig) -> Iterator[Finding]:
    """Check the interface to the cameras and the system's receive buffers."""
    named, camera = crane.cameras.interface, crane.rig().cam0
    name = interface_of(named)
    if name is None or not (Path("/sys/class/net") / name).is_dir():
        found = "none is named" if named is None else f"{named} isn't there"
        is_missing = None if named is None else False
        yield Finding("interface to the cameras", found, "one", "name it in cameras.interface", is_missing)
    else:
        yield from _interface(name, crane)
    limit, needed = _number(Path("/proc/sys/net/core/rmem_max")), 2 * camera.width * camera.height
    yield Finding(
        "receive buffer (net.core.rmem_max)", f"{limit} bytes", f"{needed} bytes, a pair",
        f"sysctl -w net.core.rmem_max={max(needed, 1 << 25)}", None if limit is None else limit >= needed,
    )  # fmt: skip


def _interface(name: str, crane: CraneConfig) -> Iterator[Finding]:
    """Check an interface's packet size and speed, and whether its clock supports PTP."""
    at, cameras, camera = Path("/sys/class/net") / name, crane.cameras, crane.rig().cam0
    needed, mtu = cameras.packet_size_bytes + HEADERS_BYTES, _number(at / "mtu") or 0
    remedy = f"ip link set {name} mtu 9000, here and in the switch, or lower cameras.packet_size_bytes"
    yield Finding(f"MTU of {name}", f"{mtu} bytes", f"{needed} bytes", remedy, mtu >= needed)
    rate = 1.1 * 2 * 8 * camera.width * camera.height * cameras.rate_hz / 1e6
    speed = _number(at / "speed") or -1
    yield Finding(
        f"speed of {name}", f"{speed} Mbit/s" if speed > 0 else "not told", f"{rate:.0f} Mbit/s",
        "use a faster network, or lower cameras.rate_hz", speed >= rate if speed > 0 else None,
    )  # fmt: skip
    has_ptp = any((at / "device" / "ptp").glob("ptp*"))
    estimated = "none, offset and drift are estimated from the stamps"
    yield Finding(f"PTP clock of {name}", "there" if has_ptp else "none", estimated, "", None)


def interface_of(named: str | None) -> str | None:
    """Return the name of an interface given by name or IPv4 address; None if there is none."""
    if named is None or not named.replace(".", "").isdigit():
        return named
    import fcntl

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        for _, name in socket.if_nameindex():
            request = name.encode()[:15].ljust(256, b"\0")
            try:
                answer = fcntl.ioctl(probe.fileno(), 0x8915, request)  # SIOCGIFADDR
            except OSError:
                continue
            if socket.inet_ntoa(answer[20:24]) == named:
                return name
    return named


def _number(path: Path) -> int | None:
    """Read a whole number; None if the system doesn't provide it."""
    try:
        return int(path.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None


def _sensors(crane: CraneConfig) -> Iterator[Finding]:
    """Check both cameras, then IMU and encoders."""
    awaited = crane.described(Path("recording"))
    size = awaited.rig.cam0.width, awaited.rig.cam0.height
    cameras = f"{' and '.join(crane.cameras.serials)}, {size[0]}x{size[1]}, Mono8"
    ptp: list[str] = []
    yield _proved("cameras", cameras, lambda: ptp.extend(prove_cameras(crane.cameras, size)))
    if ptp:
        yield _ptp(ptp)
    for name, sensor in crane.sensors().items():

        def listen(name: str = name) -> None:
            nonlocal awaited
            awaited = prove_sensor(crane, awaited, name)

        needed = f"{sensor.rate_hz:g} readings a second at {sensor.way}"
        yield _proved(name, needed, listen)
    heard = (awaited.imu_samples, awaited.crane_samples)
    if any(one is not None and len(one.stamp_ns) for one in heard):
        yield _proved("readings", "those of a crane, in SI units", lambda: expect_plausible(awaited))


def _ptp(states: list[str]) -> Finding:
    """Report whether the cameras' clocks are synchronised by PTP."""
    is_one = are_one_clock(states)
    return Finding(
        "PTP of the cameras", " and ".join(one or "none told" for one in states),
        "none, offset and drift are estimated from the stamps; Slave and Slave: one clock",
        "" if is_one else "to have one clock, enable PTP in both cameras and give their network one master",
        is_one or None,
    )  # fmt: skip


def _proved(what: str, needed: str, prove: Callable[[], None]) -> Finding:
    try:
        prove()
    except BarsightError as error:
        problem, _, remedy = str(error).partition("; ")
        return Finding(what, problem.removeprefix(f"{what}: "), needed, remedy, False)
    return Finding(what, "as crane.toml says", needed, "", True)


class _TimeX(ctypes.Structure):
    """Result of adjtimex(2)."""

    _fields_ = (
        ("modes", ctypes.c_uint), ("offset", ctypes.c_long), ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long), ("esterror", ctypes.c_long), ("status", ctypes.c_int),
        ("rest", ctypes.c_byte * 256),
    )  # fmt: skip


def _clock() -> Finding:
    """Check whether the system clock is synchronised, for example by chrony or ptp4l."""
    timex, needed = _TimeX(), "kept by chrony, ntpd or ptp4l"
    remedy = "install chrony: other computers judge the age of lifts by their own clocks"
    try:
        state = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(timex))
    except (OSError, AttributeError):
        return Finding("clock", "not told", needed, remedy, None)
    is_kept = state >= 0 and not timex.status & UNSYNCHRONISED
    found = f"kept, within {timex.maxerror / 1e3:.1f} ms" if is_kept else "free"
    return Finding("clock", found, needed, remedy, is_kept or None)
