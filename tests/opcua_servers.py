"""Start the OPC UA server and node-opcua's client for the tests, with certificates of their own."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

NODE_MODULES = (
    Path(os.environ.get("BARSIGHT_NODE_MODULES", Path.home() / ".cache/barsight/npm")) / "node_modules"
)
CLIENT_URI = "urn:tests:client"
PASSWORD = "sixteen bars up"


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def node_package(name: str) -> Path:
    """The folder of an npm package; skips where node or the package is absent."""
    if shutil.which("node") is None or not (NODE_MODULES / name).is_dir():
        pytest.skip(f"npm's {name} is not installed (run .ci/servers plant)")
    return NODE_MODULES / name


def run_node(script: str, *arguments: str) -> subprocess.Popen[str]:
    environment = {**os.environ, "NODE_PATH": str(NODE_MODULES)}
    return subprocess.Popen(
        ["node", str(Path(__file__).with_name(script)), *arguments], env=environment, text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def write_identity(folder: Path, name: str, days: float = 100) -> dict[str, str]:
    """A client's certificate and key as PEM files; returns their paths, and `der`'s."""
    from barsight.plant.opcua.security.certificates import make_certificate

    der, key = make_certificate(CLIENT_URI, name, ["localhost"], days)
    text = "\n".join(textwrap.wrap(base64.b64encode(der).decode(), 64))
    paths = {kind: folder / f"{name}.{kind}.pem" for kind in ("certificate", "key")}
    paths["certificate"].write_text(f"-----BEGIN CERTIFICATE-----\n{text}\n-----END CERTIFICATE-----\n")
    paths["key"].write_bytes(key)
    return {kind: str(path) for kind, path in paths.items()}


class OpcUaPlant:
    """A running server with its drawn plant."""

    def __init__(self, folder: Path, **settings: Any) -> None:
        from barsight.plant.opcua.security.access import add_user

        self.folder, self.port = folder, free_port()
        (folder / "pki/trusted").mkdir(parents=True)
        add_user(folder / "users.json", "engineer", "engineer", PASSWORD)
        add_user(folder / "users.json", "crane", "operator", PASSWORD)
        told = {
            "port": self.port, "folder": str(folder / "pki"), "users": str(folder / "users.json"), **settings
        }  # fmt: skip
        (folder / "settings.json").write_text(json.dumps(told))
        program = str(Path(__file__).with_name("opcua_plant.py"))
        with (folder / "log").open("w") as log:
            self._process = subprocess.Popen(
                [sys.executable, program, str(folder / "settings.json")],
                text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log,
            )  # fmt: skip
        assert self._read() == "up", self.log

    @property
    def log(self) -> str:
        return (self.folder / "log").read_text()

    @property
    def url(self) -> str:
        return f"opc.tcp://127.0.0.1:{self.port}/barsight"

    def trust(self, identity: dict[str, str]) -> None:
        shutil.copy(identity["certificate"], self.folder / "pki/trusted")

    def say(self, line: str) -> str:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()
        return self._read()

    def _read(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()

    def close(self) -> None:
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


@contextlib.contextmanager
def opcua_plant(folder: Path, **settings: Any) -> Iterator[OpcUaPlant]:
    plant = OpcUaPlant(folder, **settings)
    try:
        yield plant
    finally:
        plant.close()


def walk(plant: OpcUaPlant, folder: Path, script: str = "opcua_client.js", **config: Any) -> dict[str, Any]:
    """Run a client's walk, changing the plant as it asks, and return its report."""
    path, report = folder / "client.json", folder / "report.json"
    path.write_text(json.dumps({
        "url": plant.url, "uri": CLIENT_URI, "password": PASSWORD, "pki": str(folder / "client-pki"),
        "report": str(report), **config,
    }))  # fmt: skip
    client = run_node(script, str(path))
    assert client.stdout is not None and client.stdin is not None and client.stderr is not None
    for line in client.stdout:
        if line.startswith('{"ask"'):
            client.stdin.write(plant.say(json.loads(line)["ask"]) + "\n")
            client.stdin.flush()
    errors = client.stderr.read()
    for pipe in (client.stdin, client.stdout, client.stderr):
        pipe.close()
    assert client.wait(10) == 0, f"{errors}\n{plant.log}"
    return dict(json.loads(report.read_text()))
