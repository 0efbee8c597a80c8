"""`barsight plant run` as a command: what a PLC sees when it hangs, is killed, or the PLC is silent."""

from __future__ import annotations

import contextlib
import signal
import socket
from pathlib import Path

import pytest

pytest.importorskip("sqlalchemy")


from barsight.cli.main import run
from opcua_servers import free_port
from plant_commands import LinkedPlc, plant_run, read_out, write_config


def telegrams_left(plc: LinkedPlc) -> int:
    """The telegrams that still come, until the link is closed or none came for 300 ms: the PLC's rule."""
    plc.link.settimeout(0.3)
    count = 0
    with contextlib.suppress(OSError):
        while count < 50:
            plc.turn()
            count += 1
    return count


def test_a_run_that_hangs_or_was_killed_sends_no_life(tmp_path: Path) -> None:
    """So that the PLC sees 300 ms later that nothing is valid any more."""
    config = write_config(tmp_path, telegram={"port": (port := free_port())})
    with plant_run(config) as process, LinkedPlc(port) as first, LinkedPlc(port) as second:
        first.until_valid()
        process.send_signal(signal.SIGSTOP)
        assert telegrams_left(first) <= 1
        process.send_signal(signal.SIGCONT)
        second.until_valid()
        process.kill()
        assert telegrams_left(second) <= 1


def test_a_plc_whose_life_counter_stands_gets_no_lift(tmp_path: Path) -> None:
    config = write_config(tmp_path, telegram={"port": (port := free_port())})
    with plant_run(config), LinkedPlc(port) as plc:
        plc.until_valid()
        told = [read_out(plc.link.recv(96, socket.MSG_WAITALL)) for _ in range(8)]
        assert [one["status"] & 1 for one in told[4:]] == [0] * 4  # 300 ms are three telegrams
        assert {one["lift_id"] for one in told[4:]} == {0}
        plc.until_valid()


def test_what_is_not_configured_or_served_is_told_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["plant", "run", "--config", str(write_config(tmp_path))]) == 2
    assert "names no link" in capsys.readouterr().err
    config = write_config(tmp_path, telegram={"port": free_port()})
    assert run(["plant", "check", "--config", str(config)]) == 5
    assert "telegram: does not hold" in capsys.readouterr().out
