"""The S7 client against snap7's server, with nodes7 on the other side of the same data blocks."""

from __future__ import annotations

import json
import struct
import threading
import time
from collections.abc import Iterator

import pytest

from opcua_servers import free_port, node_package, run_node

snap7 = pytest.importorskip("snap7")

from barsight.core.errors import Failed  # noqa: E402
from barsight.plant.link_settings import S7Settings  # noqa: E402
from barsight.plant.s7 import S7Exchange, S7Link, run_s7  # noqa: E402

INPUT_BYTES, OUTPUT_BYTES = 32, 400


class DrawnPlc:
    """A PLC with the data blocks 100 (its own) and 101 (Barsight's)."""

    def __init__(self) -> None:
        self.port = free_port()
        self.blocks = {100: bytearray(INPUT_BYTES), 101: bytearray(OUTPUT_BYTES)}
        self.server = snap7.Server(log=False)
        for number, block in self.blocks.items():
            self.server.register_area(snap7.SrvArea.DB, number, block)
        self.server.start(self.port)

    def close(self) -> None:
        self.server.stop()
        self.server.destroy()


@pytest.fixture
def plc() -> Iterator[DrawnPlc]:
    one = DrawnPlc()
    yield one
    one.close()


def test_an_exchange_reads_inputs_and_writes_outputs(plc: DrawnPlc) -> None:
    """Both byte by byte, the outputs longer than one S7 telegram holds."""
    plc.blocks[100][:12] = struct.pack(">iif", 12345, -67, 8.25)
    outputs = bytes(i * 7 % 256 for i in range(OUTPUT_BYTES))
    link = S7Link(S7Settings(port=plc.port), INPUT_BYTES)
    try:
        exchanged = link.exchange(lambda: outputs)
    finally:
        link.close()
    assert isinstance(exchanged, S7Exchange), exchanged
    assert exchanged.inputs == bytes(plc.blocks[100])
    assert bytes(plc.blocks[101]) == outputs


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"read_start": 10}, "32 bytes from 10 on of data block 100 can't be read"),
        ({"write_start": 10}, "400 bytes from 10 on of data block 101 can't be written"),
        ({"write_db": 7}, "400 bytes from 0 on of data block 7 can't be written"),
        ({"port": 1}, ": no connection: "),
    ],
)
def test_a_data_block_that_is_too_short_or_absent_is_named(
    plc: DrawnPlc, settings: dict[str, int], said: str
) -> None:
    link = S7Link(S7Settings(**{"port": plc.port, **settings}), INPUT_BYTES)
    exchanged = link.exchange(lambda: bytes(OUTPUT_BYTES))
    link.close()
    assert isinstance(exchanged, Failed) and said in exchanged.reason


def test_what_is_written_is_as_it_is_then(plc: DrawnPlc, monkeypatch: pytest.MonkeyPatch) -> None:
    """The state ages while the PLC takes half a second for what it is asked for before."""
    read, began_s, asked_s = snap7.Client.db_read, time.monotonic(), []

    def slow(client: snap7.Client, *arguments: int) -> bytearray:
        time.sleep(0.5)
        return read(client, *arguments)

    def outputs() -> bytes:
        asked_s.append(time.monotonic() - began_s)
        stop.set()
        return bytes(8)

    monkeypatch.setattr(snap7.Client, "db_read", slow)
    stop = threading.Event()
    run_s7(S7Settings(port=plc.port), INPUT_BYTES, outputs, lambda _: None, stop)
    assert asked_s[0] > 0.5


def test_an_error_of_our_own_is_none_of_the_plcs(plc: DrawnPlc) -> None:
    link = S7Link(S7Settings(port=plc.port), INPUT_BYTES)
    try:
        with pytest.raises(ValueError, match="no number"):
            link.exchange(lambda: int("no number").to_bytes())
    finally:
        link.close()


def test_nodes7_sees_the_same_numbers(plc: DrawnPlc) -> None:
    """A foreign client on the PLC's side writes the inputs, and reads what was written, by its own types."""
    node_package("@st-one-io/nodes7")
    process = run_node(
        "s7_client.js", str(plc.port), "DB100,DINT0=-1234567", "DB100,REAL4=8.25", "DB100,DINT0"
    )
    out, errors = process.communicate(timeout=20)
    assert process.returncode == 0, errors
    link = S7Link(S7Settings(port=plc.port), INPUT_BYTES)
    try:
        exchanged = link.exchange(lambda: struct.pack(">Iif?", 4000000000, -42, 2.5, True))
    finally:
        link.close()
    assert isinstance(exchanged, S7Exchange), exchanged
    assert struct.unpack_from(">if", exchanged.inputs) == (-1234567, 8.25)
    words = ["DB101,DWORD0", "DB101,DINT4", "DB101,REAL8", "DB101,BYTE12"]
    process = run_node("s7_client.js", str(plc.port), *words)
    out, errors = process.communicate(timeout=20)
    assert process.returncode == 0, errors
    assert json.loads(out) == dict(zip(words, [4000000000, -42, 2.5, 1], strict=True))


def test_a_plc_that_goes_is_told_and_found_again() -> None:
    plc = DrawnPlc()
    seen: list[S7Exchange | Failed] = []
    stop = threading.Event()
    settings = S7Settings(port=plc.port, cycle_s=0.05, max_retry_s=0.2)
    thread = threading.Thread(
        target=run_s7, args=(settings, INPUT_BYTES, lambda: bytes(8), seen.append, stop)
    )  # fmt: skip
    thread.start()

    def await_kind(kind: type, since: int) -> None:
        for _ in range(200):
            if any(isinstance(one, kind) for one in seen[since:]):
                return
            time.sleep(0.05)
        raise AssertionError(f"no {kind.__name__}")

    try:
        await_kind(S7Exchange, 0)
        plc.close()
        await_kind(Failed, len(seen))
        again = DrawnPlc.__new__(DrawnPlc)
        again.port, again.blocks, again.server = plc.port, plc.blocks, snap7.Server(log=False)
        for number, block in again.blocks.items():
            again.server.register_area(snap7.SrvArea.DB, number, block)
        again.server.start(again.port)
        try:
            await_kind(S7Exchange, len(seen))
        finally:
            stop.set()
            thread.join(10)
            again.close()
    finally:
        stop.set()
        thread.join(10)
    assert not thread.is_alive()
