"""Add what a live run reports to the plant state: its mode, its survey and the crane's position."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from barsight.core.reading.live_run import read_crane_pose, read_live_state, running_folder
from barsight.plant.state import PlantState


def with_live_run(state: PlantState, folder: Path) -> PlantState:
    """Add the crane's pose, the run's mode and its survey to a state; without a run the state is invalid."""
    folder = running_folder(folder)
    live = read_live_state(folder)
    if live is None:
        return _forbidden(state, f"live-stopped: {folder / 'state.json'} is not there or torn")
    if not live.is_running:
        silent = f"says nothing for {live.silent_s:.1f} s"
        if live.silent_s < 0:
            silent = "last spoke ahead of this clock, which was set back"
        return _forbidden(state, f"live-stopped: the live run {silent}, phase {live.phase}")
    pose = read_crane_pose(folder, live.now_ns)
    state = replace(state, mode=live.mode, survey=live.phase, pose=pose)
    if live.may_stand:
        return state
    return _forbidden(state, f"live-state: {live.mode}: {'; '.join(live.reasons)}")


def _forbidden(state: PlantState, reason: str) -> PlantState:
    return replace(state, is_valid=False, reasons=(*state.reasons, reason))
