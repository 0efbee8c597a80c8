"""Open bags with types that can't all be parsed: events of a service are listed, not read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.typesys import get_types_from_msg


class BagReader(AnyReader):
    """An AnyReader that skips connections whose definition can't be parsed; all_connections includes them."""

    def __init__(self, paths: Sequence[Path], default_typestore: Any) -> None:
        super().__init__(paths, default_typestore=default_typestore)
        self._whole: list[Any] = list(self.readers)
        readable: list[Any] = [_ReadableConnections(reader) for reader in self._whole]
        self.readers = readable

    @property
    def all_connections(self) -> list[Any]:
        """Return every connection, whether its messages can be read or not."""
        return [connection for file in self._whole for connection in file.connections]


class _ReadableConnections:
    """One file's reader without the connections that can't be parsed; otherwise unchanged."""

    def __init__(self, whole: Any) -> None:
        self.whole = whole

    def __enter__(self) -> _ReadableConnections:
        self.whole.__enter__()
        return self

    def __exit__(self, *error: Any) -> Any:
        return self.whole.__exit__(*error)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.whole, name)

    @property
    def connections(self) -> list[Any]:
        """Return the connections whose messages can be read."""
        return [connection for connection in self.whole.connections if _parses(connection)]


def _parses(connection: Any) -> bool:
    """Check whether the definition of a service's events can be parsed; errors of other types are raised."""
    if not connection.msgtype.endswith("_Event"):
        return True
    if connection.msgdef.format != MessageDefinitionFormat.MSG:
        return bool(connection.msgdef.format == MessageDefinitionFormat.NONE)
    try:
        get_types_from_msg(connection.msgdef.data, connection.msgtype)
    except Exception:
        return False
    return True
