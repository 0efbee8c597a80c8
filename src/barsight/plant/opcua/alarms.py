"""Keep the conditions of alarms: raised, acknowledged with a comment, ended; each change is an event."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from barsight.plant.opcua.events import Emitter
from barsight.plant.opcua.security.access import caller, has_role
from barsight.plant.opcua.security.binding import Node, Server, ua
from barsight.plant.opcua.surveys import AlarmLine

MAX_CONDITIONS = 200
"""Maximum number of condition nodes. There are few alarm codes; more than this is a fault, which must not
fill memory.
"""
SEVERITIES = {"info": 200, "warning": 500, "error": 800}
_ON_OFF = {
    "EnabledState": ("Disabled", "Enabled"),
    "ActiveState": ("Inactive", "Active"),
    "AckedState": ("Unacknowledged", "Acknowledged"),
}


@dataclass(frozen=True)
class _Condition:
    node: Node
    alarm: AlarmLine
    is_active: bool = True
    is_acknowledged: bool = False
    event_id: bytes = b""
    comment: str = ""
    user: str = ""


class Conditions:
    """The conditions below a parent node, which emits their events through `alarm`."""

    def __init__(self, server: Server, parent: Node, emitter: Emitter, kind: Any, index: int) -> None:
        self._server = server
        self._parent = parent
        self._emitter = emitter
        self._kind = kind
        self._index = index
        self._by_code: dict[str, _Condition] = {}

    async def add_methods(self) -> None:
        """Link the methods Acknowledge, AddComment and ConditionRefresh of the base types."""
        await self._emitter.add("alarm", self._kind)
        await self._emitter.add("refresh start", ua.ObjectIds.RefreshStartEventType)
        await self._emitter.add("refresh end", ua.ObjectIds.RefreshEndEventType)
        for number, method in (
            (ua.ObjectIds.AcknowledgeableConditionType_Acknowledge, self._acknowledge),
            (ua.ObjectIds.ConditionType_AddComment, self._add_comment),
            (ua.ObjectIds.ConditionType_ConditionRefresh, self._refresh),
            (ua.ObjectIds.ConditionType_ConditionRefresh2, self._refresh),
        ):
            self._server.iserver.isession.add_method_callback(ua.NodeId(number), method)

    async def show(self, alarms: tuple[AlarmLine, ...]) -> None:
        """Raise the conditions of new alarms, and end those whose alarm has ended.

        alarms: the newest first. Only the newest of each code is shown, and raised anew if it replaces
        another.
        """
        standing = {alarm.code: alarm for alarm in reversed(alarms)}
        for code, alarm in standing.items():
            known = self._by_code.get(code)
            if known is None and len(self._by_code) < MAX_CONDITIONS:
                await self._change(_Condition(await self._add_node(code), alarm))
            elif known is not None and not (known.is_active and known.alarm == alarm):
                await self._change(_Condition(known.node, alarm))
        for code, known in list(self._by_code.items()):
            if known.is_active and code not in standing:
                await self._change(replace(known, is_active=False))

    async def acknowledge_all(self, comment: str) -> None:
        """Acknowledge every condition that isn't acknowledged yet."""
        for known in list(self._by_code.values()):
            if not known.is_acknowledged:
                user = str(caller().name)
                await self._change(replace(known, is_acknowledged=True, comment=comment, user=user))

    async def _add_node(self, code: str) -> Node:
        return await self._parent.add_object(
            ua.NodeId(f"Alarm.{code}", self._index), ua.QualifiedName(code, self._index),
            ua.NodeId(ua.ObjectIds.BaseObjectType),
        )  # fmt: skip

    async def _change(self, condition: _Condition) -> None:
        event = self._event(condition)
        self._by_code[condition.alarm.code] = replace(condition, event_id=event.EventId)
        await self._emitter.send(event)

    def _event(self, condition: _Condition) -> Any:
        alarm = condition.alarm
        states = {
            "EnabledState": True,
            "ActiveState": condition.is_active,
            "AckedState": condition.is_acknowledged,
        }
        fields: dict[str, Any] = {
            "NodeId": ua.Variant(condition.node.nodeid, ua.VariantType.NodeId),
            "ConditionName": ua.Variant(alarm.code, ua.VariantType.String),
            "ConditionClassId": ua.Variant(
                ua.NodeId(ua.ObjectIds.ProcessConditionClassType), ua.VariantType.NodeId
            ),
            "Retain": ua.Variant(
                condition.is_active or not condition.is_acknowledged, ua.VariantType.Boolean
            ),
            "Comment": ua.Variant(ua.LocalizedText(condition.comment), ua.VariantType.LocalizedText),
            "ClientUserId": ua.Variant(condition.user, ua.VariantType.String),
            "ErrorString": ua.Variant(alarm.code, ua.VariantType.String),
            "StopReaction": ua.Variant(alarm.level == "error", ua.VariantType.Boolean),
            "BlockReaction": ua.Variant(alarm.level == "error", ua.VariantType.Boolean),
        }
        for name, is_on in states.items():
            text = ua.LocalizedText(_ON_OFF[name][is_on])
            fields[name] = ua.Variant(text, ua.VariantType.LocalizedText)
            fields[f"{name}/Id"] = ua.Variant(is_on, ua.VariantType.Boolean)
        return self._emitter.make("alarm", alarm.text, SEVERITIES.get(alarm.level, 500), fields)

    def _find(self, parent: ua.NodeId, arguments: tuple[Any, ...]) -> _Condition | int:
        """Find the condition that a client refers to; otherwise return the status code of the refusal."""
        if not has_role("operator"):
            return int(ua.StatusCodes.BadUserAccessDenied)
        found = [known for known in self._by_code.values() if known.node.nodeid == parent]
        if not found:
            return int(ua.StatusCodes.BadNodeIdUnknown)
        if len(arguments) != 2 or not isinstance(arguments[1].Value, ua.LocalizedText | None):
            return int(ua.StatusCodes.BadInvalidArgument)
        if arguments[0].Value != found[0].event_id:
            return int(ua.StatusCodes.BadEventIdUnknown)
        return found[0]

    async def _acknowledge(self, parent: ua.NodeId, *arguments: Any) -> Any:
        found = self._find(parent, arguments)
        if isinstance(found, int):
            return ua.StatusCode(found)
        if found.is_acknowledged:
            return ua.StatusCode(ua.StatusCodes.BadConditionBranchAlreadyAcked)
        comment = _text(arguments[1].Value)
        await self._change(replace(found, is_acknowledged=True, comment=comment, user=str(caller().name)))
        return []

    async def _add_comment(self, parent: ua.NodeId, *arguments: Any) -> Any:
        found = self._find(parent, arguments)
        if isinstance(found, int):
            return ua.StatusCode(found)
        await self._change(replace(found, comment=_text(arguments[1].Value), user=str(caller().name)))
        return []

    async def _refresh(self, parent: ua.NodeId, *arguments: Any) -> Any:
        subscription = arguments[0].Value if arguments else None
        known_ones = self._server.iserver.subscription_service.subscriptions
        if not isinstance(subscription, int) or subscription not in known_ones:
            return ua.StatusCode(ua.StatusCodes.BadSubscriptionIdInvalid)
        await self._emitter.send(self._emitter.make("refresh start", "refresh", 1, {}), subscription)
        for known in list(self._by_code.values()):
            if known.is_active or not known.is_acknowledged:
                event = self._event(known)
                event.EventId = known.event_id
                await self._emitter.send(event, subscription)
        await self._emitter.send(self._emitter.make("refresh end", "refresh", 1, {}), subscription)
        return []


def _text(comment: Any) -> str:
    return (comment.Text or "")[:1000] if comment is not None else ""
