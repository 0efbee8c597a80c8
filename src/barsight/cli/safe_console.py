"""Print to terminals with unsafe characters escaped by `printable`."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.text import Text

from barsight.core.printing import printable


class SafeConsole(Console):
    """A console that makes text, markup and table cells printable; all commands print with it."""

    def render_str(self, text: str, **given: Any) -> Text:
        """Render text after making it printable."""
        return super().render_str(printable(text), **given)

    def print_line(self, text: str) -> None:
        """Print text unchanged at any length, so that paths can be copied and nothing in it is taken as
        markup.
        """
        self.print(text, soft_wrap=True, highlight=False, markup=False)
