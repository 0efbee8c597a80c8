"""Play a device at a serial line: serial_sender.py LINK RATE_HZ; LINK leads to its pseudo terminal.

Lines on standard input, RATE_HZ a second: bytes to send, in hex, or `unplug SECONDS`.
"""

import os
import sys
import time
from pathlib import Path


def plug(link: Path) -> int:
    device, end = os.openpty()
    link.symlink_to(os.ttyname(end))
    return device


def main() -> None:
    link, step_s = Path(sys.argv[1]), 1.0 / float(sys.argv[2])
    device = plug(link)
    print("plugged", flush=True)
    due = time.monotonic()
    for line in sys.stdin:
        if line.startswith("unplug"):
            link.unlink()
            os.close(device)
            time.sleep(float(line.split()[1]))
            device, due = plug(link), time.monotonic()
            continue
        due = max(due + step_s, time.monotonic() - 0.1)
        time.sleep(max(due - time.monotonic(), 0))
        os.write(device, bytes.fromhex(line))


if __name__ == "__main__":
    main()
