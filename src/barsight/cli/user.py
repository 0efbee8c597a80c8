"""Name who runs a command, for the audit log."""

from __future__ import annotations

import getpass
import os


def user_name() -> str:
    """Name the computer's user for the audit log."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a container's user may have no name
        return f"uid {os.getuid()}"
