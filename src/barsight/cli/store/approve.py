"""Run `barsight store approve URL CALIBRATION`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import tyro

from barsight.calibration.files.rig_formats import read_rig_file
from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.store.audit import entry, user_name
from barsight.store.calibrations import approve_calibration, find_calibration, note_calibration
from barsight.store.confirmation import yard_clock_ns
from barsight.store.history import parse_time, time_text
from barsight.store.opening import open_store
from barsight.yard_frame import calibration_id


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, approve the calibration and print the result."""

    def command(
        url: tyro.conf.Positional[str], calibration: tyro.conf.Positional[str],
        valid_from: str | None = None, valid_until: str | None = None, by: str | None = None,
        note: str = "", rig: str | None = None, crane: str | None = None,
    ) -> None:  # fmt: skip
        """Approve a calibration of a rig for a period; at its start, the rig's older approvals end.

        Once a calibration of a rig has been approved, lifts are only offered on maps measured with a valid
        one; offers on other maps end.

        Args:
            url: SQLAlchemy URL of the database.
            calibration: Its rig file, or the beginning of the calibration_id in the surveys.
            valid_from: Start, in ISO 8601 with zone, like 2026-11-23T14:00:00Z, or integer ns; default now.
            valid_until: End, in the same form, which may be now to end the approval; no end by default.
            by: Name of the person who approves it; by default the name of the user.
            note: A sentence for the store, such as the number of a certificate.
            rig: Name of the rig, if the store does not know this calibration or its rig yet.
            crane: Name of the crane that carries the rig, if the rig is new.
        """
        given = Path(calibration)
        digest = calibration_id(read_rig_file(given)) if given.exists() else None
        until_ns = None if valid_until is None else parse_time(valid_until)
        who = by or user_name()
        with open_store(url) as store, entry(store, who, f"calibration {calibration} approved") as opened:
            digest = digest or find_calibration(opened.connection, calibration)
            clock_ns = yard_clock_ns(opened.connection)
            from_ns = clock_ns if valid_from is None else parse_time(valid_from)
            name = note_calibration(opened, digest, rig, crane)
            approve_calibration(opened, digest, from_ns, until_ns, note)
        until = "" if until_ns is None else f" until {time_text(until_ns)}"
        message = f"calibration {digest} of rig {name} is approved by {who}, from {time_text(from_ns)}{until}"
        SafeConsole().print(message, highlight=False, soft_wrap=True)

    call(command, "store approve", arguments)
