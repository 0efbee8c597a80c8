"""Define the result of a link's check."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LinkCheck:
    """Result of a link's check. lines: for people. is_good: whether the link holds."""

    link: str
    lines: tuple[str, ...]
    is_good: bool
