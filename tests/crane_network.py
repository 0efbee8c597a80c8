"""Two GigE Vision cameras, an IMU and encoders in network namespaces: a live run's counterpart."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

import barsight as bs
from barsight.calibration.files.kalibr import write_imu_file
from barsight.calibration.files.rig_file import write_rig_file
from barsight.core.records.pairs import StereoFrame
from barsight.recording.base import Recording
from gige_camera import library

TESTS = Path(__file__).parent
SERIALS = ("BARSIGHT-L", "BARSIGHT-R")
PORTS = {"imu": 5601, "crane": 5602}
STILLS, STILL_NS = 8, 400_000_000
"""So many pictures of the standing crane, so far apart, come before a recording that is played."""


def missing() -> str:
    """Tell why no cameras can be had here; empty where they can."""
    if importlib.util.find_spec("viva_genicam") is None:
        return "viva-genicam is not installed (extra: cameras)"
    try:
        library()
    except OSError:
        return "libaravis-0.8 is not installed (.ci/servers installs it)"
    if os.geteuid() != 0 or shutil.which("ip") is None:
        return "network namespaces need root and iproute2"
    told = try_namespace()
    return f"no network namespaces here: {told}" if told else ""


def try_namespace() -> str:
    """Make a namespace of this process's own and remove it, even if the process is killed meanwhile; tell why
    it can't be made.
    """
    name = f"bs-try{os.getpid()}"
    tried = subprocess.run(
        ["sh", "-c", f"ip netns add {name} && ip netns del {name}"],
        start_new_session=True, capture_output=True, text=True, check=False,
    )  # fmt: skip
    return tried.stderr.strip()


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


@contextmanager
def plant() -> Iterator["Plant"]:
    """A host and two cameras' places, each in a namespace, on one bridge of MTU 9000."""
    name = f"bs{os.getpid()}"
    spaces = [name, f"{name}l", f"{name}r"]
    try:
        for space in spaces:
            ip("netns", "add", space)
            ip("-n", space, "link", "set", "lo", "up")
        ip("-n", name, "link", "add", "br0", "type", "bridge")
        ip("-n", name, "addr", "add", "10.98.0.1/24", "dev", "br0")
        ip("-n", name, "link", "set", "br0", "mtu", "9000", "up")
        for number, space in enumerate(spaces[1:]):
            peer = ("peer", "name", f"c{number}", "mtu", "9000", "netns", name)
            ip("-n", space, "link", "add", "e0", "mtu", "9000", "type", "veth", *peer)
            ip("-n", name, "link", "set", f"c{number}", "master", "br0", "up")
            ip("-n", space, "addr", "add", f"10.98.0.1{number}/24", "dev", "e0")
            ip("-n", space, "link", "set", "e0", "up")
        with ExitStack() as stack:
            yield Plant(spaces, stack)
    finally:
        for space in spaces:
            subprocess.run(["ip", "netns", "del", space], capture_output=True, check=False)


class Plant:
    """Starts programs in the namespaces; `stack` ends them."""

    def __init__(self, spaces: list[str], stack: ExitStack) -> None:
        self.spaces, self._stack = spaces, stack

    def start(self, space: int, *command: str, quiet: bool = True) -> subprocess.Popen[str]:
        """Start Python with a command: at the host (0), or in the place of cam0 (1) or cam1 (2)."""
        pipe = subprocess.DEVNULL if quiet else subprocess.PIPE
        process = subprocess.Popen(
            ["ip", "netns", "exec", self.spaces[space], sys.executable, *command],
            stdout=pipe, stderr=pipe, text=True,
        )  # fmt: skip
        self._stack.callback(end, process)
        return process

    def camera(
        self, number: int, pictures: Path, times: str, offset_ns: int = 0, drift_ppm: float = 0.0,
        serial: str = "", ptp: tuple[str, ...] = (),
    ) -> subprocess.Popen[str]:  # fmt: skip
        """Start a camera, see `gige_camera`."""
        return self.start(
            number + 1, str(TESTS / "gige_camera.py"), "e0", serial or SERIALS[number], str(pictures), times,
            str(offset_ns), str(drift_ppm), *ptp,
        )  # fmt: skip

    def cable(self, number: int, state: str) -> None:
        """Plug a camera's cable `down` or `up`."""
        ip("-n", self.spaces[number + 1], "link", "set", "e0", state)

    def lose(self, number: int, percent: float) -> None:
        """Lose a share of what a camera sends, by nftables; none with 0."""
        nft = ["ip", "netns", "exec", self.spaces[number + 1], "nft"]
        lines = ["delete table inet loss"]
        if percent:
            lines = [
                "add table inet loss", "add chain inet loss out { type filter hook output priority 0; }",
                f"add rule inet loss out numgen random mod 100000 < {round(1000 * percent)} drop",
            ]  # fmt: skip
        subprocess.run([*nft, "; ".join(lines)], check=True, capture_output=True)


def end(process: subprocess.Popen[str]) -> None:
    """End a process that was started here."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    if process.stdin is not None:
        process.stdin.close()


def play(plant: Plant, recording: Recording, folder: Path, in_s: float) -> int:
    """Play a recording's pictures and readings in so many seconds from now; returns the host's time (ns) that
    its first pair has. Readings begin at once: of a crane that stands.
    """
    first_ns, pairs = recording.index.stamps_ns[0], list(recording.frames())
    begin_ns = time.time_ns() + round(in_s * 1e9)
    times = np.array(recording.index.stamps_ns) - first_ns + begin_ns
    times = np.concatenate([begin_ns - STILL_NS * np.arange(STILLS, 0, -1), times])
    np.save(folder / "times.npy", times)
    for number, side in enumerate(("left", "right")):
        pictures = [getattr(pair, side) for pair in pairs if isinstance(pair, StereoFrame)]
        np.save(folder / f"{side}.npy", np.array([*pictures[:1] * STILLS, *pictures]))
        plant.camera(number, folder / f"{side}.npy", str(folder / "times.npy"), (-7, 11)[number] * 10**9)
    imu, crane = recording.imu(), recording.crane()
    assert imu is not None and crane is not None
    shift_ns = first_ns + recording.rig.timeshift_cam_imu_ns - begin_ns
    for sensor, stamps, values in (
        ("imu", imu.stamp_ns, np.hstack([imu.gyro_radps, imu.accel_mps2])),
        ("crane", crane.stamp_ns, crane.position_m),
    ):
        np.savez(folder / f"{sensor}.npz", stamps=stamps - shift_ns, values=values)
        plant.start(
            0, str(TESTS / "crane_sender.py"), sensor, str(PORTS[sensor]), str(folder / f"{sensor}.npz")
        )
    return begin_ns


def describe(recording: Path, folder: Path, changes: dict[str, str] | None = None) -> Path:
    """Write crane.toml and the calibration for a recording's rig. changes: texts in place of others."""
    known = bs.open_recording(recording)
    mounted, noise = known.crane(), known.imu_noise()
    assert mounted is not None and noise is not None
    write_rig_file(folder / "rig.yaml", known.rig)
    lines = (folder / "rig.yaml").read_text().replace("cam0:\n", f"cam0:\n  serial: {SERIALS[0]}\n", 1)
    (folder / "rig.yaml").write_text(lines.replace("cam1:\n", f"cam1:\n  serial: {SERIALS[1]}\n", 1))
    write_imu_file(folder / "imu.yaml", noise, "/imu0")
    lever, turn = mounted.crane_to_body_m.tolist(), mounted.yard_from_body_nominal.ravel().tolist()
    text = f"""
calibration = "rig.yaml"
[cameras]
serials = {json.dumps(SERIALS)}
rate_hz = 3.0
trigger = "Software"
[imu]
port = {PORTS["imu"]}
rate_hz = 200
noise = "imu.yaml"
[encoders]
port = {PORTS["crane"]}
rate_hz = 20
p_crane_body_m = {lever}
R_yard_body = {turn}
position_std_m = {mounted.position_std_m}
[measure.recording]
pair_tolerance_s = 0.01
"""
    for old, new in (changes or {}).items():
        assert old in text, old
        text = text.replace(old, new)
    path = folder / "crane.toml"
    path.write_text(text)
    return path
