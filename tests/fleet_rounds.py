"""Stand-ins for the fleet's tests: small files, a measurement that only digests, an S3 server."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

STAND_IN = """
import hashlib, json, pathlib, sys, time
words = sys.argv[1:]
source, out = pathlib.Path(words[0]), pathlib.Path(words[words.index("-o") + 1])
kind = (source / "mav0" / "kind").read_text()
if kind == "poison":
    sys.exit("barsight: this recording is torn")
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
