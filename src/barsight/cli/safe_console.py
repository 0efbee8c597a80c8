"""Print to terminals by `printable`."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.text import Text

from barsight.core.printing import printable


class SafeConsole(Console):
    """A console whose text, markup and tables' cells are printable; all commands print with it."""

    def render_str(self, text: str, **given: Any) -> Text:
        """Render text that is printable."""
        return super().render_str(printable(text), **given)

    def print_line(self, text: str) -> None:
        """Print text as it stands, however long: paths can be copied, and nothing in it is markup."""
        self.print(text, soft_wrap=True, highlight=False, markup=False)
