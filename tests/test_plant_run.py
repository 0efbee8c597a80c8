"""`barsight plant run` as a command: what a PLC sees when it hangs, is killed, or the PLC is silent."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import struct
import subprocess
import time
from pathlib import Path

import pytest

pytest.importorskip("sqlalchemy")


from barsight.cli.main import run
from opcua_servers import free_port
from plant_commands import IN, LinkedPlc, plant_run, read_out, write_config


def valid_telegrams_left(plc: LinkedPlc) -> int:
    """The telegrams that still let the PLC act, until one doesn't, or none came for 300 ms."""
    plc.link.settimeout(0.3)
    count = 0
    with contextlib.suppress(OSError):
        while plc.turn()["status"] & 1:
            count += 1
    return count


def children(process: subprocess.Popen[str]) -> list[int]:
    """The processes that a run has started, but for Python's own tracker of resources."""
    tasks = Path(f"/proc/{process.pid}/task").iterdir()
    found = [one for task in tasks for one in (task / "children").read_text().split()]
    return [int(one) for one in found if b"spawn_main" in Path(f"/proc/{one}/cmdline").read_bytes()]


def ended(pid: int) -> bool:
    """Wait until a process is gone, or waits for whoever inherited it."""
    for _ in range(100):
        try:
            if Path(f"/proc/{pid}/stat").read_text().split()[2] == "Z":
                return True
        except FileNotFoundError:
            return True
        time.sleep(0.1)
    return False


@pytest.mark.parametrize("victim", ["run", "telegram"])
def test_whichever_process_hangs_or_is_killed_nothing_stays_valid(tmp_path: Path, victim: str) -> None:
    """Within 300 ms, which are three telegrams and one on its way, or by the PLC's own count of them."""
    config = write_config(tmp_path, telegram={"port": (port := free_port())})
    with plant_run(config) as process, LinkedPlc(port) as first, LinkedPlc(port) as second:
        (child,) = children(process)
        pid = process.pid if victim == "run" else child
        first.until_valid()
        os.kill(pid, signal.SIGSTOP)
        assert valid_telegrams_left(first) <= 4
        os.kill(pid, signal.SIGCONT)
        second.until_valid()
        os.kill(pid, signal.SIGKILL)
        assert valid_telegrams_left(second) <= 1
        assert process.wait(10) != 0
        assert ended(child)


def test_a_plc_whose_life_counter_stands_gets_no_lift(tmp_path: Path) -> None:
    config = write_config(tmp_path, telegram={"port": (port := free_port())})
    with plant_run(config), LinkedPlc(port) as plc:
        plc.until_valid()
        told = [read_out(plc.link.recv(98, socket.MSG_WAITALL)) for _ in range(8)]
        assert [one["status"] & 1 for one in told[4:]] == [0] * 4  # 300 ms are three telegrams
        assert {one["lift_id"] for one in told[4:]} == {0}
        plc.until_valid()


def test_of_two_plcs_at_one_address_the_later_gets_nothing_while_the_first_is_alive(tmp_path: Path) -> None:
    """It could report the first one's lift as failed while the load hangs, also if that is silent a while."""
    config = write_config(tmp_path, telegram={"port": (port := free_port())})
    with plant_run(config), LinkedPlc(port) as first, LinkedPlc(port) as second:
        first.until_valid()
        claim = (first.life + 1, 0, 0, 0, 0, 0, 0, 1, 1, 1, 0, 0)
        second.link.sendall(IN.pack(0xB51B, 1, *claim))
        told = [(first.turn(), second.turn()) for _ in range(8)]
        assert all(mine["status"] & 1 for mine, _ in told)
        told += [(first.turn(), second.turn())] + [(told[0][0], second.turn()) for _ in range(8)]
        assert {(other["status"] & 1, other["answer"], other["lift_id"]) for _, other in told} == {(0, 0, 0)}
        first.until_valid()
        first.link.close()
        second.until_valid()


def test_a_plc_that_comes_again_is_served_while_its_old_connection_stands(tmp_path: Path) -> None:
    config = write_config(tmp_path, telegram={"port": (port := free_port())})
    with plant_run(config), LinkedPlc(port) as cut_off:
        cut_off.until_valid()
        with LinkedPlc(port) as again:
            again.until_valid()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (struct.pack("<HHHHqiiiIHHIII", 0xB51B, 1, 1, *[0] * 11), "bytes are in the other order than big"),
        (IN.pack(0xB51B, 1, 1, 0x1F, *[0] * 10), "flags 0x1f"),
        (IN.pack(0xB51B, 1, 1, 0, 0, 0x42DA0000, *[0] * 8), "its position, 112158 m, is in no yard"),
    ],
    ids=["byte order", "flags", "float"],
)
def test_what_is_wrong_with_telegrams_is_told(tmp_path: Path, content: bytes, said: str) -> None:
    """The other byte order, a bit too many, a float: the PLC sees no more than its connection close."""
    port = free_port()
    with plant_run(write_config(tmp_path, telegram={"port": port})) as process:
        for _ in range(3):
            with LinkedPlc(port) as plc:
                plc.link.sendall(content)
                plc.link.recv(98)
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("plc 127.0.0.1: ") and said in line


def test_what_is_not_configured_or_served_is_told_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["plant", "run", "--config", str(write_config(tmp_path))]) == 2
    assert "names no link" in capsys.readouterr().err
    config = write_config(tmp_path, telegram={"port": free_port()})
    assert run(["plant", "check", "--config", str(config)]) == 5
    assert "telegram: does not hold" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("table", "settings", "wanted"),
    [
        ("opcua", {"nodesets": "nowhere"}, "NodeSet2.xml: no such file; run: npm install"),
        (
            "webhooks",
            {"urls": ["http://127.0.0.1:1/"], "secret_file": "none"},
            "give the file with the secret",
        ),
    ],
)
def test_a_file_that_a_link_needs_is_told_in_one_line_before_it_serves(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], table: str, settings: dict[str, object], wanted: str
) -> None:
    told = settings | ({"port": free_port()} if table == "opcua" else {})
    assert run(["plant", "run", "--config", str(write_config(tmp_path, **{table: told}))]) in (2, 3)
    (line,) = capfd.readouterr().err.splitlines()
    assert wanted in line
