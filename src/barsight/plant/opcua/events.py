"""Emit events to clients that monitor the server or the vision system."""

from __future__ import annotations

import copy
import datetime
import uuid
from typing import Any

from barsight.plant.opcua.security.binding import EventGenerator, Node, Server, ua


class Emitter:
    """Hold one event of each type, and send filled-in copies of it from several nodes.

    asyncua sends an event only to clients that monitor one particular node; a client that monitors the Server
    object must also get the events of the objects below it (OPC 10000-3, 4.6).
    """

    def __init__(self, server: Server, sources: list[Node]) -> None:
        self._server = server
        self.sources = sources
        self._models: dict[str, Any] = {}

    async def add(self, name: str, kind: Any) -> None:
        """Read the fields of the event type with node id `kind`, and register it under `name`."""
        generator = EventGenerator(self._server.iserver.isession)
        for source in self.sources:
            await generator.init(kind, source, add_generates_event=False)
        generator.event.SourceNode = self.sources[-1].nodeid
        generator.event.SourceName = (await self.sources[-1].read_browse_name()).Name
        self._models[name] = generator.event

    def make(self, name: str, message: str, severity: int, fields: dict[str, Any]) -> Any:
        """Make an event. fields: values by name (`FromState/Id`), or Variants, which also set the type."""
        event = copy.copy(self._models[name])
        event.data_types = dict(event.data_types)
        now = datetime.datetime.now(datetime.UTC)
        event.EventId = uuid.uuid4().hex.encode()
        event.Time = event.ReceiveTime = now
        event.data_types["EventId"] = ua.VariantType.ByteString
        event.Message = ua.LocalizedText(message)
        event.Severity = severity
        for key, value in fields.items():
            is_variant = isinstance(value, ua.Variant)
            setattr(event, key, value.Value if is_variant else value)
            if is_variant:
                event.data_types[key] = value.VariantType
        return event

    async def send(self, event: Any, subscription: int | None = None) -> None:
        """Send an event from each source, to all subscriptions or to the given one."""
        service = self._server.iserver.subscription_service
        chosen = service.subscriptions if subscription is None else {subscription: None}
        for source in self.sources:
            sent = copy.copy(event)
            sent.emitting_node = source.nodeid
            for number in list(chosen):
                if (found := service.subscriptions.get(number)) is not None:
                    await found.monitored_item_srv.trigger_event(sent)

    async def emit(self, name: str, message: str, severity: int = 100, **fields: Any) -> None:
        """Make an event and send it."""
        await self.send(self.make(name, message, severity, fields))
