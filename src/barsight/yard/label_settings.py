"""Define the settings for labels on bundles."""

from __future__ import annotations

from dataclasses import dataclass

from barsight.core.errors import ConfigError
from barsight.core.settings.values import expect_ranges


@dataclass(frozen=True)
class LabelSettings:
    """Settings for labels on bundles."""

    read: bool = False
    """Read the labels' codes in the pictures (extra `labels`; takes 0.1 to 0.2 s per picture), attach
    them to the bundles and compare them with the stock list.
    """
    numbers: bool = False
    """Also read plain numbers of three or more digits where no code is read (extra `numbers`, and Tesseract's
    English data: Debian's `tesseract-ocr-eng`).
    """
    size_m: tuple[float, float] = (0.1, 0.06)
    """Length and width of a label: a bright plate of this size on a bundle that can't be read in any picture
    is reported as illegible; with 0 0, none are searched for.
    """

    def __post_init__(self) -> None:
        expect_ranges(self, "labels.", size_m=(0, 0.6))
        if self.numbers and not (self.read and min(self.size_m) > 0):
            raise ConfigError("labels.numbers needs labels.read and a label's size, labels.size_m")
