"""Answer method calls: role and arguments are checked before anything is done."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

from barsight.plant.opcua.security.access import has_role
from barsight.plant.opcua.security.binding import Node, Server, ua

Handler = Callable[..., Awaitable[Any]]
MAX_TEXT = 4096
_PLAIN = {
    1: (bool,), 6: (int,), 7: (int,), 8: (int,), 9: (int,), 11: (float,), 12: (str, type(None)),
    15: (bytes, type(None)), 17: (ua.NodeId,), 21: (ua.LocalizedText, type(None)),
}  # fmt: skip
"""Python types of the OPC UA base types: Boolean, integers, Double, String, ByteString, NodeId,
LocalizedText.
"""


async def answer_method(server: Server, node: Node, role: str, handler: Handler) -> None:
    """Answer a method by `handler`, for callers with `role` whose arguments match the node's declaration."""
    declared: list[Any] = []
    for child in await node.get_properties():
        if (await child.read_browse_name()).Name == "InputArguments":
            declared = list(await child.read_value() or [])

    async def guarded(parent: ua.NodeId, *arguments: ua.Variant) -> Any:
        if not has_role(role):
            return ua.StatusCode(ua.StatusCodes.BadUserAccessDenied)
        if len(arguments) < len(declared):
            return ua.StatusCode(ua.StatusCodes.BadArgumentsMissing)
        if len(arguments) > len(declared):
            return ua.StatusCode(ua.StatusCodes.BadTooManyArguments)
        values = [argument.Value for argument in arguments]
        if not all(_fits(value, one) for value, one in zip(values, declared, strict=True)):
            return ua.StatusCode(ua.StatusCodes.BadInvalidArgument)
        return await handler(*values)

    server.link_method(node, guarded)


def _fits(value: Any, declared: Any) -> bool:
    if declared.ValueRank == 1:
        return value is None or isinstance(value, list)
    kind = declared.DataType
    if kind.NamespaceIndex == 0 and kind.Identifier in _PLAIN:
        is_bool = isinstance(value, bool)
        fits = isinstance(value, _PLAIN[kind.Identifier]) and (not is_bool or kind.Identifier == 1)
        return fits and not (isinstance(value, str | bytes) and len(value) > MAX_TEXT)
    structure = ua.extension_objects_by_datatype.get(kind)
    if structure is not None:
        return value is None or isinstance(value, structure)
    return not isinstance(value, list)
