"""The plant's commands as processes, with a PLC and a yard management system on their other ends."""

from __future__ import annotations

import json
import os
import socket
import struct
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

from page_yards import fill_store

IN = struct.Struct(">HHHHqiiiIHHIII")


def read_out(content: bytes) -> dict[str, int]:
    """The fields that a PLC's program needs of 98 bytes, by the table of bytes."""
    lift_id, checksum = struct.unpack_from(">II", content, 16)
    number, answer, _, token = struct.unpack_from(">HHHI", content, 70)
    return {
        "life": struct.unpack_from(">H", content, 4)[0], "status": struct.unpack_from(">H", content, 6)[0],
        "lift_id": lift_id, "checksum": checksum, "mass": struct.unpack_from(">I", content, 60)[0],
        "number": number, "answer": answer, "token": token,
    }  # fmt: skip


@cache
def _filled() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        return Path(fill_store(Path(folder)).removeprefix("sqlite:///")).read_bytes()


def yard_store(folder: Path) -> str:
    """A store of its own with three lifts on offer, made once; return its URL."""
    (folder / "yard.db").write_bytes(_filled())
    return f"sqlite:///{folder / 'yard.db'}"


def write_config(folder: Path, **tables: dict[str, Any]) -> Path:
    """plant.toml for a store in this folder."""
    given = {"store": {"url": yard_store(folder), "allow_simulated": True}, **tables}
    lines = []
    for name, table in given.items():
        lines.append(f"[{name}]")
        lines += [f"{key} = {json.dumps(value)}" for key, value in table.items()]
    path = folder / "plant.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


@contextmanager
def plant_run(config: Path, links: int = 1) -> Iterator[subprocess.Popen[str]]:
    """The command, as soon as it has told its links; killed at the end where it still runs."""
    process = subprocess.Popen(
        [sys.executable, "-m", "barsight", "plant", "run", "--config", str(config)], text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    assert process.stdout is not None and process.stderr is not None
    try:
        for _ in range(links):
            assert process.stdout.readline(), process.stderr.read()
        yield process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
        process.stderr.close()


class LinkedPlc:
    """A PLC on a plain socket, that exchanges telegrams and keeps when each came."""

    def __init__(self, port: int) -> None:
        self.link = socket.create_connection(("127.0.0.1", port), timeout=5)
        self.life = 0

    def turn(self) -> dict[str, int]:
        self.life = (self.life + 1) & 0xFFFF
        self.link.sendall(IN.pack(0xB51B, 1, self.life, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0))
        content = self.link.recv(98, socket.MSG_WAITALL)
        if len(content) < 98:
            raise ConnectionError("closed")
        return read_out(content)

    def __enter__(self) -> LinkedPlc:
        return self

    def __exit__(self, *_: object) -> None:
        self.link.close()

    def until_valid(self) -> None:
        assert any(self.turn()["status"] & 1 for _ in range(50))


class Hooks:
    """An address of a yard management system, that keeps all posts. answers: to the first ones; then 204."""

    def __init__(self) -> None:
        posts: list[dict[str, Any]] = []
        self.posts, self.answers = posts, list[int]()
        hooks = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                raw = self.rfile.read(int(self.headers["Content-Length"]))
                code = hooks.answers.pop(0) if hooks.answers else 204
                self.send_response(code)
                if code == 302:
                    self.send_header("Location", "/elsewhere")
                self.end_headers()
                posts.append(
                    {**json.loads(raw), "raw": raw, "signature": self.headers["X-Barsight-Signature"]}
                )

            def log_message(self, *_: object) -> None: ...

        self.server = HTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}/hook"
        self._thread = threading.Thread(target=self.server.serve_forever, args=(0.05,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        self.server.shutdown()
        self._thread.join()
        self.server.server_close()
