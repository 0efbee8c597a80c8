"""Every fault of `fault_rounds` once: told by name, lifts revoked, all well again, the recording readable.

How soon is measured by `python tests/fault_rounds.py` on a machine without other work; here bounds are wide.
"""

from pathlib import Path

import pytest

from crane_network import missing
from fault_rounds import FAULTS, GIVE_UP_S, run_rounds

WHY_NOT = missing()
pytestmark = pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT or "cameras are here")


@pytest.mark.slow
def test_each_fault_is_told_revokes_lifts_and_is_over_when_it_is_over(tmp_path: Path) -> None:
    table, ended = run_rounds(1, 6, list(FAULTS), tmp_path)
    assert set(table) == set(FAULTS)
    for name, found in table.items():
        assert len(found.told_s) == (1 if FAULTS[name].reason else 0), name
        assert found.missed == 0 and max(found.back_s) < GIVE_UP_S, name
        assert all(stood < 5.0 for stood in found.revoked_s), name
    assert int(ended.split(";")[1].split()[0]) > 0, ended
