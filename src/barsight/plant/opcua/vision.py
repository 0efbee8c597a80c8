"""Provide a vision system of OPC 40100-1 in the address space, and drive its state machine."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from barsight.core.errors import Failed
from barsight.plant.opcua.calls import Handler, answer_method
from barsight.plant.opcua.events import Emitter
from barsight.plant.opcua.machine import (
    AUTOMATIC_STATES,
    MAIN_STATES,
    Step,
    VisionMode,
    step_by_itself,
    step_by_method,
)
from barsight.plant.opcua.security.access import caller
from barsight.plant.opcua.security.binding import Node, Server, ua

VISION_URI = "http://opcfoundation.org/UA/MachineVision"
_SYSTEM, _MACHINE, _AUTOMATIC = 1003, 1017, 1021
_EVENTS = {
    "state": 1018, "recipe prepared": 1022, "ready": 1023, "job started": 1013, "result ready": 1024,
    "acquisition done": 1025, "error": 1019, "error resolved": 1020,
}  # fmt: skip
ERROR_CONDITION = 1035
_BARE_IDS = {
    "RecipeIdExternalDataType": 3002,
    "RecipeIdInternalDataType": 3013,
    "ConfigurationIdDataType": 3008,
}
_SYSTEM_STATES = {"Preoperational": 3, "Halted": 4, "Error": 5, "Operational": 2}
"""SystemStateDataType: engineering, scheduled downtime, unscheduled downtime, standby; 1 is production."""


class VisionSystem:
    """The vision system's nodes and its mode. Clients call methods one at a time (one event loop)."""

    def __init__(self, server: Server, index: int, vision_index: int, system: Node, emitter: Emitter) -> None:
        self.server = server
        self.index = index
        self.vision_index = vision_index
        self.system = system
        self.emitter = emitter
        self.mode = VisionMode()
        self._states: dict[str, ua.NodeId] = {}
        self._transitions: dict[str, tuple[ua.NodeId, int]] = {}
        self._machines: dict[str, Node] = {}

    @classmethod
    async def add(cls, server: Server, nodeset: Path, index: int) -> VisionSystem:
        """Import the NodeSet, add `VisionSystem` below Objects, and start in Preoperational."""
        await server.import_xml(nodeset)
        await server.load_data_type_definitions()
        vision_index = await server.get_namespace_index(VISION_URI)
        await _register_ids(server, vision_index)
        system = await server.nodes.objects.add_object(
            ua.NodeId("VisionSystem", index), ua.QualifiedName("VisionSystem", index),
            objecttype=ua.NodeId(_SYSTEM, vision_index), instantiate_optional=True,
        )  # fmt: skip
        emitter = Emitter(server, [server.nodes.server, system])
        for name, number in _EVENTS.items():
            await emitter.add(name, ua.NodeId(number, vision_index))
        vision = cls(server, index, vision_index, system, emitter)
        await vision._learn()
        await vision._show(None)
        for method in ("Halt", "Reset"):
            await vision.answer(("VisionStateMachine", method), "engineer", vision._by_cause(method))
        await vision.answer(
            ("VisionStateMachine", "SelectModeAutomatic"), "operator", vision._by_cause("SelectModeAutomatic")
        )
        return vision

    def node(self, number: int) -> ua.NodeId:
        """Form the id of a node of the companion specification."""
        return ua.NodeId(number, self.vision_index)

    async def find(self, path: tuple[str, ...]) -> Node:
        """Find a node below the system by names of the companion specification (`0:` for base names)."""
        names = [name if ":" in name else f"{self.vision_index}:{name}" for name in path]
        return await self.system.get_child(names)

    async def answer(self, path: tuple[str, ...], role: str, handler: Handler) -> None:
        """Answer a method by `handler`, for callers who have `role`."""

        node = await self.find(path)
        await answer_method(self.server, node, role, handler)

    async def step(self, method: str) -> Failed | None:
        """Apply a client's method and emit the event; return Failed if the mode doesn't allow it."""
        return await self._take(step_by_method(self.mode, method), f"{method} by {caller().name}")

    async def step_itself(self, cause: str) -> Failed | None:
        """Apply an internal cause and emit the event."""
        return await self._take(step_by_itself(self.mode, cause), cause)

    async def _take(self, step: Step | Failed, cause: str) -> Failed | None:
        if isinstance(step, Failed):
            return step
        before, self.mode = self.mode, step.mode
        await self._show(step)
        old, new = _name_of(before, step), _name_of(self.mode, step)
        node, number = self._transitions[step.transition]
        await self.emitter.emit(
            "state", f"{old} to {new}: {cause}", 200,
            **{
                "FromState": ua.Variant(ua.LocalizedText(old), ua.VariantType.LocalizedText),
                "FromState/Id": ua.Variant(self._states[old], ua.VariantType.NodeId),
                "ToState": ua.Variant(ua.LocalizedText(new), ua.VariantType.LocalizedText),
                "ToState/Id": ua.Variant(self._states[new], ua.VariantType.NodeId),
                "Transition": ua.Variant(ua.LocalizedText(step.transition), ua.VariantType.LocalizedText),
                "Transition/Id": ua.Variant(node, ua.VariantType.NodeId),
                "Transition/Number": ua.Variant(number, ua.VariantType.UInt32),
                "CausePath": ua.Variant(cause, ua.VariantType.String),
            },
        )  # fmt: skip
        return None

    def _by_cause(self, method: str) -> Handler:
        async def stepped(*arguments: Any) -> Any:
            return refusal(await self.step(method)) or [int32(0)]

        return stepped

    async def _learn(self) -> None:
        """Read the node ids of states and transitions from the types, and add missing optional nodes."""
        for number in (_MACHINE, _AUTOMATIC):
            for child in await self.server.get_node(self.node(number)).get_children():
                name = (await child.read_browse_name()).Name
                if name in MAIN_STATES or name in AUTOMATIC_STATES:
                    self._states[name] = child.nodeid
                elif await child.read_type_definition() == ua.NodeId(ua.ObjectIds.TransitionType):
                    transition = await (await child.get_child("0:TransitionNumber")).read_value()
                    self._transitions[name] = (child.nodeid, int(transition))
        main = await self.find(("VisionStateMachine",))
        self._machines = {
            "main": main, "automatic": await self.find(("VisionStateMachine", "AutomaticModeStateMachine"))
        }  # fmt: skip
        for name, machine in self._machines.items():
            state = await machine.get_child("0:CurrentState")
            await self._property(state, name, "Id", ua.NodeId(), ua.VariantType.NodeId)
            await self._property(state, name, "Number", 0, ua.VariantType.UInt32)

    async def _property(self, state: Node, machine: str, name: str, value: Any, kind: ua.VariantType) -> None:
        have = {(await child.read_browse_name()).Name for child in await state.get_properties()}
        if name not in have:
            await state.add_property(
                ua.NodeId(f"VisionSystem.{machine}.CurrentState.{name}", self.index),
                ua.QualifiedName(name, 0), value, varianttype=kind,
            )  # fmt: skip

    async def _show(self, step: Step | None) -> None:
        for machine, name in (("main", self.mode.main), ("automatic", self.mode.automatic)):
            state = await self._machines[machine].get_child("0:CurrentState")
            number = {**MAIN_STATES, **AUTOMATIC_STATES}.get(name or "", 0)
            node = self._states[name] if name else ua.NodeId()
            status = ua.StatusCode(ua.StatusCodes.Good if name else ua.StatusCodes.BadStateNotActive)
            for target, value in (
                (state, ua.Variant(ua.LocalizedText(name), ua.VariantType.LocalizedText)),
                (await state.get_child("0:Id"), ua.Variant(node, ua.VariantType.NodeId)),
                (await state.get_child("0:Number"), ua.Variant(number, ua.VariantType.UInt32)),
            ):
                shown = ua.DataValue(value if name else ua.Variant(), status)
                await self.server.write_attribute_value(target.nodeid, shown)
        described = ua.SystemStateDescriptionDataType()
        described.State = ua.SystemStateDataType(
            1 if self.mode.is_executing else _SYSTEM_STATES[self.mode.main]
        )
        described.StateDescription = self.mode.automatic or self.mode.main
        await (await self.find(("SystemState",))).write_value(
            ua.Variant(described, ua.VariantType.ExtensionObject)
        )


async def _register_ids(server: Server, vision_index: int) -> None:
    """Register the ids of types that add no field to their base type.

    asyncua takes them for the base type itself, whose encoding has another id.
    """
    for name, number in _BARE_IDS.items():
        kind = server.get_node(ua.NodeId(number, vision_index))
        encodings = await kind.get_referenced_nodes(ua.ObjectIds.HasEncoding)
        binary = [one for one in encodings if (await one.read_browse_name()).Name == "Default Binary"]
        delattr(ua, name)
        derived: Any = dataclass(type(name, (ua.BinaryIdBaseDataType,), {"__module__": __name__}))
        ua.register_extension_object(name, binary[0].nodeid, derived, kind.nodeid)


def int32(value: int) -> ua.Variant:
    """Make the Int32 with which the specification's methods end: 0 for success."""
    return ua.Variant(value, ua.VariantType.Int32)


def refusal(failed: Failed | None) -> ua.StatusCode | None:
    """Return the status code for a method that the state machine doesn't currently allow."""
    return None if failed is None else ua.StatusCode(ua.StatusCodes.BadInvalidState)


def _name_of(mode: VisionMode, step: Step) -> str:
    """Name the state that a transition leaves or enters, in the state machine that has the transition."""
    is_automatic = any(step.transition.startswith(f"{name}To") for name in AUTOMATIC_STATES)
    return mode.automatic or mode.main if is_automatic else mode.main
