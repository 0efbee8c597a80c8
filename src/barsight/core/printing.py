"""Make text printable: names and texts from files that others made can't give a terminal orders."""

from __future__ import annotations

import unicodedata

_HARMLESS = "\n\t"
_ORDERS = ("Cc", "Cf", "Cs", "Co", "Zl", "Zp")
"""Unicode's categories of control and format characters, surrogates, private ones and line breaks."""


def printable(text: str) -> str:
    """Replace control characters, and bytes of names that are no text, by a question mark."""
    if text.isprintable():
        return text
    return "".join(
        "?" if sign not in _HARMLESS and unicodedata.category(sign) in _ORDERS else sign for sign in text
    )
