"""Define the result of a link check."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LinkCheck:
    """Result of a link check. lines: human-readable findings. is_good: True if the link passed."""

    link: str
    lines: tuple[str, ...]
    is_good: bool
