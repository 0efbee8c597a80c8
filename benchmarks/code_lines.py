"""Count lines of code without docstrings, comments and blank lines, room by room: `python
benchmarks/code_lines.py REVISION ...`.
"""

from __future__ import annotations

import ast
import io
import subprocess
import sys
import tokenize
from collections import Counter

NOT_CODE = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER
}  # fmt: skip
PACKAGE = "src/barsight"


def code_lines(source: str) -> int:
    """Count the lines that hold code; a string that stands alone is documentation."""
    documented: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Expr(value=ast.Constant(value=str())):
                documented |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in NOT_CODE:
            lines |= set(range(token.start[0], token.end[0] + 1))
    return len(lines - documented)


def count_rooms(revision: str) -> Counter[str]:
    """Count by sub-package; `top` holds the package's own modules."""
    rooms: Counter[str] = Counter()
    for name in _git("ls-tree", "-r", "--name-only", revision, PACKAGE).split():
        if name.endswith(".py"):
            inside = name.removeprefix(f"{PACKAGE}/").split("/")
            rooms[inside[0] if len(inside) > 1 else "top"] += code_lines(_git("show", f"{revision}:{name}"))
    return rooms


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], capture_output=True, text=True, check=True).stdout


def main() -> None:
    """Print a table, a column for each revision."""
    counted = [count_rooms(revision) for revision in sys.argv[1:]]
    for room in sorted({room for one in counted for room in one}):
        print(f"{room:<14}" + "".join(f"{one[room]:>9}" for one in counted))
    print(f"{'all':<14}" + "".join(f"{sum(one.values()):>9}" for one in counted))


if __name__ == "__main__":
    main()
