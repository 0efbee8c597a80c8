"""Transfer result files: a client opens one, reads it in pieces, and closes it."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, BinaryIO

from barsight.plant.opcua.calls import answer_method
from barsight.plant.opcua.results import TRANSFERRED, KeptResults
from barsight.plant.opcua.security.binding import Node, Server, ua

MAX_OPEN = 10
MAX_PIECE_BYTES = 1 << 20
IDLE_S = 60.0
"""Time in seconds without a read after which an open file is closed."""


@dataclass
class _OpenFile:
    node: Node
    file: BinaryIO
    used_at: float


class Transfers:
    """Files that clients are reading, each a FileType object below the vision system."""

    def __init__(self, server: Server, parent: Node, index: int, results: KeptResults) -> None:
        self._server = server
        self._parent = parent
        self._index = index
        self._results = results
        self._open: dict[int, _OpenFile] = {}
        self._handles = 0

    async def open(self, options: Any) -> Any:
        """Answer GenerateFileForRead: open the height map of the result named by the options."""
        await self._close_idle()
        wanted = getattr(options, "Id", None)
        result = self._results.get(str(wanted.Id or "")) if wanted is not None else None
        if result is None or not result.has_file:
            return ua.StatusCode(ua.StatusCodes.BadNotFound)
        if len(self._open) >= MAX_OPEN:
            return ua.StatusCode(ua.StatusCodes.BadResourceUnavailable)
        file = (result.folder / TRANSFERRED).open("rb")
        self._handles += 1
        number = self._handles
        name = f"Transfer.{number}"
        node = await self._parent.add_object(
            ua.NodeId(name, self._index), ua.QualifiedName(name, self._index),
            objecttype=ua.NodeId(ua.ObjectIds.FileType),
        )  # fmt: skip
        self._open[number] = _OpenFile(node, file, time.monotonic())
        for method, handler in (
            ("Read", self._reader(number)), ("Close", self._closer(number)),
            ("GetPosition", self._teller(number)), ("SetPosition", self._seeker(number)),
        ):  # fmt: skip
            await answer_method(self._server, await node.get_child(f"0:{method}"), "viewer", handler)
        return [
            ua.Variant(node.nodeid, ua.VariantType.NodeId), ua.Variant(number, ua.VariantType.UInt32),
            ua.Variant(ua.NodeId(), ua.VariantType.NodeId),
        ]  # fmt: skip

    def _use(self, number: int, given: int) -> BinaryIO | None:
        transfer = self._open.get(number)
        if transfer is None or given != number:
            return None
        transfer.used_at = time.monotonic()
        return transfer.file

    def _reader(self, number: int) -> Any:
        async def read(given: int, length: int) -> Any:
            file = self._use(number, given)
            if file is None or length < 0:
                return ua.StatusCode(ua.StatusCodes.BadInvalidArgument)
            return [ua.Variant(file.read(min(length, MAX_PIECE_BYTES)), ua.VariantType.ByteString)]

        return read

    def _closer(self, number: int) -> Any:
        async def close(given: int) -> Any:
            if self._use(number, given) is None:
                return ua.StatusCode(ua.StatusCodes.BadInvalidArgument)
            await self._close(number)
            return []

        return close

    def _teller(self, number: int) -> Any:
        async def tell(given: int) -> Any:
            file = self._use(number, given)
            if file is None:
                return ua.StatusCode(ua.StatusCodes.BadInvalidArgument)
            return [ua.Variant(file.tell(), ua.VariantType.UInt64)]

        return tell

    def _seeker(self, number: int) -> Any:
        async def seek(given: int, position: int) -> Any:
            file = self._use(number, given)
            if file is None or not isinstance(position, int) or not 0 <= position < 1 << 40:
                return ua.StatusCode(ua.StatusCodes.BadInvalidArgument)
            file.seek(position)
            return []

        return seek

    async def _close(self, number: int) -> None:
        transfer = self._open.pop(number)
        transfer.file.close()
        await self._server.delete_nodes([transfer.node], recursive=True)

    async def _close_idle(self) -> None:
        for number, transfer in list(self._open.items()):
            if time.monotonic() - transfer.used_at > IDLE_S:
                await self._close(number)
