"""Show a frozen snapshot as plain variables: a node for each field, a folder for each nested dataclass."""

from __future__ import annotations

import dataclasses
import datetime
import enum
import json
import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from barsight.core.json_values import json_value
from barsight.plant.opcua.security.binding import Node, Server, ua

_SCALARS = {
    bool: ua.VariantType.Boolean,
    int: ua.VariantType.Int64,
    float: ua.VariantType.Double,
    str: ua.VariantType.String,
}

_ZEROS: dict[ua.VariantType, Any] = {
    ua.VariantType.Boolean: False,
    ua.VariantType.Int64: 0,
    ua.VariantType.Double: 0.0,
    ua.VariantType.String: "",
}
"""Initial values by type, which a node has until its first value is written."""


@dataclass(frozen=True)
class Leaf:
    """A field that holds a value. path: names from the snapshot down. kind: of the value or array values."""

    path: tuple[str, ...]
    kind: ua.VariantType
    is_array: bool
    is_json: bool


def leaves_of(kind: type, path: tuple[str, ...] = ()) -> Iterator[Leaf]:
    """List the leaves of a dataclass by its annotations; all but scalars and arrays of them is JSON."""
    hints = typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        inner = _without_none(hints[field.name])
        inner_path = (*path, field.name)
        if isinstance(inner, type) and dataclasses.is_dataclass(inner):
            yield from leaves_of(inner, inner_path)
        elif (scalar := _scalar(inner)) is not None:
            yield Leaf(inner_path, scalar, False, False)
        elif typing.get_origin(inner) is tuple and (scalar := _common(typing.get_args(inner))) is not None:
            yield Leaf(inner_path, scalar, True, False)
        else:
            yield Leaf(inner_path, ua.VariantType.String, False, True)


def value_of(snapshot: Any, leaf: Leaf) -> Any:
    """Read a leaf's value from a snapshot; None if it, or a field that contains it, is None."""
    value = snapshot
    for name in leaf.path:
        if value is None:
            return None
        value = getattr(value, name)
    if isinstance(value, enum.Enum):
        value = value.value
    if leaf.is_json and value is not None:
        return json.dumps(json_value(value), allow_nan=False)
    if leaf.is_array and value is not None:
        return list(value)
    return float(value) if leaf.kind is ua.VariantType.Double and value is not None else value


class StateVariables:
    """The variables of one kind of snapshot below a parent node; a value is written when it has changed.

    `quiet` sets all of them Bad, so that no client takes an outdated value for a current one.
    """

    def __init__(self, server: Server, nodes: dict[Leaf, Node]) -> None:
        self._server = server
        self._nodes = nodes
        self._written: dict[Leaf, tuple[Any, int]] = {}

    @classmethod
    async def add(cls, server: Server, parent: Node, kind: type, index: int) -> StateVariables:
        """Add the nodes below `parent`; their ids have the form `State.lift.x_m`."""
        folders: dict[tuple[str, ...], Node] = {(): parent}
        nodes: dict[Leaf, Node] = {}
        for leaf in leaves_of(kind):
            for depth in range(1, len(leaf.path)):
                path = leaf.path[:depth]
                if path not in folders:
                    folders[path] = await folders[path[:-1]].add_object(
                        ua.NodeId(".".join(("State", *path)), index), ua.QualifiedName(path[-1], index)
                    )
            start = ua.Variant([] if leaf.is_array else _ZEROS[leaf.kind], leaf.kind, is_array=leaf.is_array)
            nodes[leaf] = await folders[leaf.path[:-1]].add_variable(
                ua.NodeId(".".join(("State", *leaf.path)), index), ua.QualifiedName(leaf.path[-1], index),
                start, varianttype=leaf.kind, datatype=ua.NodeId(leaf.kind.value),
            )  # fmt: skip
        variables = cls(server, nodes)
        await variables.quiet(ua.StatusCodes.BadWaitingForInitialData)
        return variables

    async def show(self, snapshot: Any) -> None:
        """Write the values that differ from those shown."""
        for leaf, node in self._nodes.items():
            value = value_of(snapshot, leaf)
            status = ua.StatusCodes.Good if value is not None else ua.StatusCodes.BadNoData
            await self._write(leaf, node, value, status)

    async def quiet(self, status: int) -> None:
        """Set all variables to a Bad status without a value."""
        for leaf, node in self._nodes.items():
            await self._write(leaf, node, None, status)

    async def _write(self, leaf: Leaf, node: Node, value: Any, status: int) -> None:
        if self._written.get(leaf) == (value, status):
            return
        self._written[leaf] = (value, status)
        now = datetime.datetime.now(datetime.UTC)
        variant = ua.Variant(value, leaf.kind, is_array=leaf.is_array) if value is not None else ua.Variant()
        shown = ua.DataValue(variant, ua.StatusCode(status), SourceTimestamp=now, ServerTimestamp=now)
        await self._server.write_attribute_value(node.nodeid, shown)


def _without_none(kind: Any) -> Any:
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        rest = [one for one in typing.get_args(kind) if one is not type(None)]
        return rest[0] if len(rest) == 1 else kind
    return kind


def _scalar(kind: Any) -> ua.VariantType | None:
    if typing.get_origin(kind) is typing.Literal:
        return _common(tuple(type(one) for one in typing.get_args(kind)))
    if isinstance(kind, type) and issubclass(kind, enum.Enum):
        return _common(tuple(type(one.value) for one in kind))
    return _SCALARS.get(kind)


def _common(kinds: tuple[Any, ...]) -> ua.VariantType | None:
    found = {_scalar(one) for one in kinds if one is not Ellipsis}
    return found.pop() if len(found) == 1 else None
