"""Define the settings of the labels on bundles."""

from __future__ import annotations

from dataclasses import dataclass

from barsight.core.errors import ConfigError
from barsight.core.settings.values import expect_ranges


@dataclass(frozen=True)
class LabelSettings:
    """The labels on bundles."""

    read: bool = False
    """Read their codes in the pictures (extra `labels`; a tenth of a second a picture), attach them to the
    bundles and hold them against the stock list."""
    numbers: bool = False
    """Read plain numbers too, of three digits and more, where no code is read (extra `numbers`, and
    Tesseract's English data: Debian's `tesseract-ocr-eng`)."""
    size_m: tuple[float, float] = (0.1, 0.06)
    """Length and width of a label: a bright plate of this size on a bundle that no picture reads is called
    illegible; 0 0 looks for none."""

    def __post_init__(self) -> None:
        expect_ranges(self, "labels.", size_m=(0, 0.6))
        if self.numbers and not (self.read and min(self.size_m) > 0):
            raise ConfigError("labels.numbers needs labels.read and a label's size, labels.size_m")
