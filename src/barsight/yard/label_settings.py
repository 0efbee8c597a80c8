"""Define the settings of the labels on bundles."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LabelSettings:
    """The codes on bundles' labels."""

    read: bool = False
    """Read them in the pictures (extra `labels`; a tenth of a second a picture), attach them to the bundles
    and hold them against the stock list."""
