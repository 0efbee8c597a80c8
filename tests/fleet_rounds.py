"""Stand-ins for the fleet's tests and benchmarks: small files, a measurement that only digests, servers."""

from __future__ import annotations

import base64
import contextlib
import hmac
import os
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from email.utils import formatdate
from pathlib import Path

import pytest

from barsight.fleet.objects import open_objects
from barsight.fleet.task import TaskLimits, TaskSettings
from barsight.fleet.versions import Version, installed_software
from opcua_servers import free_port, node_package

STAND_IN = """
import hashlib, json, pathlib, sys, time
words = sys.argv[1:]
source, out = pathlib.Path(words[0]), pathlib.Path(words[words.index("-o") + 1])
kind = (source / "mav0" / "kind").read_text()
if kind == "poison":
    sys.exit("barsight: this recording is damaged")
if kind == "named":
    sys.exit(f"barsight: {source}: is damaged; record it again ({source.parent}/imu.yaml is fine)")
if kind == "large":
    held = bytearray(600 << 20)
    held[::4096] = b"1" * len(held[::4096])
    time.sleep(60)
if kind == "hangs":
    time.sleep(60)
time.sleep(float(kind.split()[1]) if " " in kind else 0)
out.mkdir()
data = b"".join(p.read_bytes() for p in sorted(source.rglob("*")) if p.is_file())
(out / "bundles.json").write_text(json.dumps({"sha": hashlib.sha256(data).hexdigest()}))
(out / "result.json").write_text("{}")
"""


CAMERA = ("--camera.width-px", "320", "--camera.height-px", "256", "--camera.focal-px", "312")
SMALL = ("--length", "2", "--frames", "5", *CAMERA)
"""Of `simulate`: a recording that takes some seconds to measure."""
BARSIGHT = (sys.executable, "-m", "barsight")


def call(folder: Path, *words: object) -> str:
    """Run a command of Barsight in a folder to its end; what it printed."""
    command = [*BARSIGHT, *map(str, words)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(command[2:])}: {done.stderr[-500:]}")
    return done.stdout


def dask_commands(port: int, workers: int) -> dict[str, list[str]]:
    """The commands of a scheduler at a port and of its workers without nannies, by name."""
    dask = [sys.executable, "-m", "distributed.cli.dask_"]
    at = ["--host", "127.0.0.1", "--port", str(port), "--no-dashboard"]
    own = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--memory-limit", "0"]
    worker = [*dask[:2], f"{dask[2]}worker", f"tcp://127.0.0.1:{port}", *own]
    return {"scheduler": [*dask[:2], f"{dask[2]}scheduler", *at]} | {
        f"worker {number}": worker for number in range(workers)
    }


VERSION = Version("v1", "configuration", "", "", installed_software())


def settings(folder: Path, results: str, **more: float) -> TaskSettings:
    """Settings of a run whose measurement is a stand-in, with results that know VERSION."""
    limits = TaskLimits(**{"lease_s": 5.0, **more})  # type: ignore[arg-type]
    open_objects(results, create=True).write(f"versions/{VERSION.name}/files.json", b"{}")
    return TaskSettings(results, None, limits, command=stand_in(folder))


def no_progress(*_: int) -> None:
    """Take progress."""


def stand_in(folder: Path) -> tuple[str, ...]:
    """The command of a measurement that only digests its recording."""
    path = folder / "stand_in.py"
    path.write_text(STAND_IN)
    return sys.executable, "-I", str(path)


def make_archive(folder: Path, kinds: dict[str, str]) -> Path:
    """Recordings of a few bytes; kind: what their measurement will do."""
    for name, kind in kinds.items():
        inner = folder / name / "mav0"
        inner.mkdir(parents=True)
        (inner / "kind").write_text(kind)
        (inner / "name").write_text(name)
    return folder


AZURE = {
    "AZURE_STORAGE_USE_EMULATOR": "true",
    "AZURE_STORAGE_ACCOUNT_NAME": "devstoreaccount1",
    "AZURE_STORAGE_ACCOUNT_KEY": (
        "Eby8vdM02xNOcqFlqUwJPLlmEtlCDXJ1OUzFT50uSRZ6IFsuFq2UVErCz4I6tq/K1SZFPTOtr/KBHBeksoGMGw=="
    ),
}
"""Azurite's own account, which its documentation names."""


@contextlib.contextmanager
def azure_server(folder: Path) -> Iterator[str]:
    """Azure's emulator on this machine with the container `yard`; skips where npm's azurite isn't."""
    script, port = node_package("azurite") / "dist/src/blob/main.js", free_port()
    command = ["node", str(script), "--blobPort", str(port), "--location", str(folder), "--silent"]
    server = subprocess.Popen(
        [*command, "--skipApiVersionCheck", "--disableTelemetry"], stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    url = f"http://127.0.0.1:{port}"
    try:
        for _ in range(200):
            with contextlib.suppress(urllib.error.URLError), urllib.request.urlopen(_new_container(url)):
                break
            time.sleep(0.1)
        yield url
    finally:
        server.kill()
        server.wait()


def _new_container(url: str) -> urllib.request.Request:
    """The request that makes `yard`, signed by the account's key (SharedKey)."""
    name, version = AZURE["AZURE_STORAGE_ACCOUNT_NAME"], "2021-08-06"
    headers = {"x-ms-date": formatdate(usegmt=True), "x-ms-version": version}
    lines = ["PUT", *[""] * 11, *(f"{key}:{value}" for key, value in headers.items())]
    text = "\n".join([*lines, f"/{name}/{name}/yard", "restype:container"])
    digest = hmac.digest(base64.b64decode(AZURE["AZURE_STORAGE_ACCOUNT_KEY"]), text.encode(), "sha256")
    headers["Authorization"] = f"SharedKey {name}:{base64.b64encode(digest).decode()}"
    place = f"{url}/{name}/yard?restype=container"
    return urllib.request.Request(place, method="PUT", headers=headers)


@contextlib.contextmanager
def moto_server(port: int | None = None) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """An S3 server of this machine with the bucket `yard`; skips where moto's server isn't installed."""
    pytest.importorskip("moto.server", reason="moto[s3,server] is not installed")
    if port is None:
        with socket.socket() as found:
            found.bind(("127.0.0.1", 0))
            port = found.getsockname()[1]
    command = [sys.executable, "-W", "ignore", "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    url = f"http://127.0.0.1:{port}"
    try:
        for _ in range(200):
            with contextlib.suppress(OSError):
                request = urllib.request.Request(f"{url}/yard", method="PUT")
                with urllib.request.urlopen(request, timeout=5):
                    break
            time.sleep(0.05)
        yield url, server
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(server.pid, 9)
        server.wait()
