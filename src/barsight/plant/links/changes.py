"""Derive the changes between two states, as events for MQTT and webhooks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from barsight.plant.state import MAX_ALARMS, MAX_CODES, PlantAlarm, PlantState


def changes_between(old: PlantState | None, new: PlantState) -> list[dict[str, Any]]:
    """List the events: `validity`, `survey`, `lift`, `alarm-raised`, `alarm-ended`.

    old: None at first: after `started` all that stands is then told, and whether anything is offered, as a
    receiver may hold what was told before this process began.
    """
    events: list[dict[str, Any]] = []
    is_first = old is None
    if old is None:
        events.append({"event": "started"})
        old = PlantState("idle", False, (), 0, 0, "none")
    if is_first or old.is_valid != new.is_valid:
        events.append({"event": "validity", "is_valid": new.is_valid, "reasons": list(new.reasons)})
    if new.map_id is not None and old.map_id != new.map_id:
        events.append({"event": "survey", "map_id": new.map_id})
    before, after = _lift(old), _lift(new)
    if is_first or before != after:
        events.append({"event": "lift", "was": before, "is": after})
    for alarm in (Counter(_alarms(new)) - Counter(_alarms(old))).elements():
        text = {"code": alarm.code, "text": alarm.text, "priority": alarm.priority}
        events.append({"event": "alarm-raised", **text})
    events += [{"event": "alarm-ended", "code": one.code, "text": one.text} for one in _ended(old, new)]
    return [{**one, "stamp_ns": new.stamp_ns} for one in events]


def _alarms(state: PlantState) -> list[PlantAlarm]:
    """List a state's alarms in their order, ignoring whether they are active or acknowledged."""
    return [replace(alarm, is_active=True, is_acknowledged=False) for alarm in state.alarms]


def _ended(old: PlantState, new: PlantState) -> Iterator[PlantAlarm]:
    """Yield the alarms that have ended.

    If more stand than the state lists, those at the list's end may only have dropped off it; they don't count
    as long as another alarm of their code stands, or the state lists as many codes as it may. An active one
    whose cause is gone may drop off too, as active ones come first: that counts.
    """
    stood, standing = _alarms(old), _alarms(new)
    if len(standing) >= MAX_ALARMS:
        first, codes = standing[:MAX_ALARMS], {alarm.code for alarm in standing}
        last = max((k for k, alarm in enumerate(stood[:MAX_ALARMS]) if alarm in first), default=0)
        is_full = len(standing) >= MAX_ALARMS + MAX_CODES
        stood = stood[:last] + [one for one in stood[last:] if one.code not in codes and not is_full]
    yield from (Counter(stood) - Counter(standing)).elements()


def _lift(state: PlantState) -> dict[str, Any] | None:
    return None if state.lift is None else {"lift_id": state.lift.lift_id, "handshake": state.lift.handshake}
