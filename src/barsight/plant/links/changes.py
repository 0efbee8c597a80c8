"""Tell what changed between two states, as events for MQTT and webhooks."""

from __future__ import annotations

from typing import Any

from barsight.plant.state import PlantState


def changes_between(old: PlantState | None, new: PlantState) -> list[dict[str, Any]]:
    """List the events: `validity`, `survey`, `lift`, `alarm-raised`, `alarm-ended`. old: None at first."""
    if old is None:
        return []
    told: list[dict[str, Any]] = []
    if old.is_valid != new.is_valid:
        told.append({"event": "validity", "is_valid": new.is_valid, "reasons": list(new.reasons)})
    if new.map_id is not None and old.map_id != new.map_id:
        told.append({"event": "survey", "map_id": new.map_id})
    before, after = _lift(old), _lift(new)
    if before != after:
        told.append({"event": "lift", "was": before, "is": after})
    standing, stood = ({alarm.code: alarm for alarm in state.alarms} for state in (new, old))
    for code, alarm in standing.items():
        if code not in stood:
            text = {"code": code, "text": alarm.text, "priority": alarm.priority}
            told.append({"event": "alarm-raised", **text})
    told += [{"event": "alarm-ended", "code": code} for code in stood if code not in standing]
    return [{**one, "stamp_ns": new.stamp_ns} for one in told]


def _lift(state: PlantState) -> dict[str, Any] | None:
    return None if state.lift is None else {"lift_id": state.lift.lift_id, "handshake": state.lift.handshake}
