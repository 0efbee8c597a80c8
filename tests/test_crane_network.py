"""Workers that look at once for what the tests at a crane's cameras need find it alike."""

import subprocess
import sys

import pytest

from crane_network import TESTS, missing

WHY_NOT = missing()
LOOKS = """
import crane_network
print("ready", flush=True)
input()
print([why for why in (crane_network.missing() for _ in range(40)) if why])
"""


@pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT or "namespaces can be had")
def test_workers_that_look_at_once_do_not_hinder_each_other() -> None:
    pipe = subprocess.PIPE
    workers = [
        subprocess.Popen([sys.executable, "-c", LOOKS], cwd=TESTS, stdin=pipe, stdout=pipe, text=True)
        for _ in range(2)
    ]
    for worker in workers:
        assert worker.stdout is not None and worker.stdout.readline() == "ready\n"
    for worker in workers:
        assert worker.stdin is not None
        worker.stdin.write("\n")
        worker.stdin.flush()
    assert [worker.communicate(timeout=60)[0].strip() for worker in workers] == ["[]", "[]"]
    left = subprocess.run(["ip", "netns", "list"], capture_output=True, text=True, check=True).stdout
    assert not any(f"bs-try{worker.pid}" in left for worker in workers)
