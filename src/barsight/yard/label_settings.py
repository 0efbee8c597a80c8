"""Define the settings of the labels on bundles."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LabelSettings:
    """The codes on bundles' labels."""

    read: bool = False
    """Whether they are read in the pictures (extra `labels`; a tenth of a second a picture), attached to the
    bundles and held against the stock list."""
