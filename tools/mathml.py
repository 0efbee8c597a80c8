"""MkDocs hook: render formulas between dollar signs as MathML, which browsers show without any script."""

from __future__ import annotations

import html
import re

from latex2mathml.converter import convert

FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_content(content: str, **_: object) -> str:
    """Replace each formula that `pymdownx.arithmatex` marked by its MathML."""
    return FORMULA.sub(_rendered, content)


def _rendered(match: re.Match[str]) -> str:
    display = "block" if match[2] == "[" else "inline"
    return str(convert(html.unescape(match[3]).strip(), display=display))
