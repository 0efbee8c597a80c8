"""Every fault of `fault_rounds` once: told by name, lifts revoked, all well again, the recording readable.

How soon is measured by `python tests/fault_rounds.py` on a machine without other work; here bounds are wide.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import barsight as bs
from barsight.core.records.sensor_samples import ImuSamples
from barsight.motion.crane.encoder_jumps import find_jumps
from barsight.motion.crane.known_motion import KnownMotion
from barsight.simulation.simulate import simulate
from crane_network import missing
from fault_rounds import FAULTS, GIVE_UP_S, LINE_FAULTS, WALK, prepare, run_rounds

WHY_NOT = missing()


@pytest.mark.slow
def test_the_crane_that_is_played_has_no_jump_of_its_own(tmp_path: Path) -> None:
    """Nor where it turns: what the player sends of two rounds is what a crane could send."""
    simulate(tmp_path / "recording", WALK)
    recording = bs.open_recording(tmp_path / "recording")
    crane = recording.crane()
    assert crane is not None
    period_s, _ = prepare(recording, tmp_path, 0, 0.1)
    held, sent = np.load(tmp_path / "readings.npz"), {}
    for name in ("imu", "crane"):
        seconds = np.concatenate([held[f"{name}_s"] + k * period_s for k in range(2)])
        sent[name] = np.round(1e9 * seconds).astype(np.int64), np.vstack([held[f"{name}_values"]] * 2)
        assert (np.diff(sent[name][0]) > 0).all()
    stamps, values = sent["imu"]
    known = KnownMotion(None, ImuSamples(stamps, values[:, :3].copy(), values[:, 3:].copy()))
    assert find_jumps(replace(crane, stamp_ns=sent["crane"][0], position_m=sent["crane"][1]), known) == ()


@pytest.mark.slow
@pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT or "cameras are here")
def test_each_fault_is_told_revokes_lifts_and_is_over_when_it_is_over(tmp_path: Path) -> None:
    table, ended = run_rounds(1, 6, FAULTS, tmp_path)
    assert set(table) == set(FAULTS)
    for name, found in table.items():
        assert len(found.told_s) == (1 if FAULTS[name].reason else 0), name
        assert found.missed == 0 and max(found.back_s) < GIVE_UP_S, name
        assert all(stood < 5.0 for stood in found.revoked_s), name
    assert int(ended.split(";")[1].split()[0]) > 0, ended


@pytest.mark.slow
@pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT or "cameras are here")
def test_a_serial_line_that_is_unplugged_is_told_and_all_is_well_when_it_is_back(tmp_path: Path) -> None:
    table, ended = run_rounds(2, 7, LINE_FAULTS, tmp_path)
    for name, found in table.items():
        assert len(found.told_s) == 2 and found.missed == found.invalid == 0, (name, found)
        assert max(found.told_s) < 1.0 and max(found.back_s) < 10.0, (name, found)
    assert len(table["encoders unplugged 2 s"].revoked_s) == 2
    assert int(ended.split(";")[1].split()[0]) > 0, ended
