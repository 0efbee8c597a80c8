"""A bundle that is to be fetched: the plant is offered the lift that begins its order, and no other."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("sqlalchemy")

from barsight.plant.state import PlantState, state_of_store
from barsight.store.adding import add_survey, read_survey
from barsight.store.confirmation import confirm_lift, end_lift, open_lifts
from barsight.store.opening import Store, open_store
from barsight.yard.lifting.lift_file import read_lifts
from yard_folders import lifts, write_folder


def offered_after(folder: Path, store: Store, *arguments: str) -> PlantState:
    write_folder(folder)
    assert lifts(folder, *arguments) == 0
    add_survey(store, read_survey(folder), "ann")
    return state_of_store(store, 1, allow_simulated=True)


@pytest.mark.parametrize("wanted", [0, 1])
def test_the_plant_is_offered_what_begins_the_order_and_nothing_after_it(tmp_path: Path, wanted: int) -> None:
    with open_store(f"sqlite:///{tmp_path / 'yard.db'}", create=True) as store:
        state = offered_after(tmp_path / "out", store, "--fetch", str(wanted), "--max-stack-m", "3")
        content = read_lifts(tmp_path / "out" / "lifts.json")
        (own,) = (one for one in content["lifts"] if one["bundles"] == [wanted])
        assert len(content["lifts"]) == 2 and state.lift is not None
        assert own["set_down"] == content["fetch"]["steps"][0]["set_down"]
        assert (state.lift.x_m, state.lift.y_m) == (own["target"]["x_m"], own["target"]["y_m"])
        assert state.lift.set_down_x_m == own["crane_set_down"]["x_m"]
        end_lift(store, state.lift.lift_id, "expired", "ann", "declined")
        assert state_of_store(store, 2, allow_simulated=True).lift is None
        with store.reading() as connection:
            (other,) = open_lifts(connection)
        confirm_lift(store, other.lift_id, other.map_id, "ann")
        claimed = state_of_store(store, 3, allow_simulated=True).lift
        assert claimed is not None and claimed.lift_id == other.lift_id, "what an operator confirms is told"
