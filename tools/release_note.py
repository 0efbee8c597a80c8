"""Print a version's release note, which is its part of CHANGELOG.md: `python tools/release_note.py 0.2.0`."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
SEMANTIC = re.compile(r"(0|[1-9]\d*)\.(0|[1-9]\d*)\.(0|[1-9]\d*)(-[0-9A-Za-z.-]+)?")


def release_note(version: str, changelog: str, packaged: str) -> str:
    """Cut the part of `version` out of a changelog in the form of Keep a Changelog.

    packaged: pyproject.toml's version. Raises ValueError for a version that isn't semantic or isn't packaged,
    and where its part is missing, undated or empty.
    """
    if not SEMANTIC.fullmatch(version):
        raise ValueError(f"{version} is no semantic version")
    if version != packaged:
        raise ValueError(f"pyproject.toml has version {packaged}, not {version}")
    head = re.search(rf"^## \[{re.escape(version)}\] - \d{{4}}-\d\d-\d\d\n", changelog, re.MULTILINE)
    if head is None:
        raise ValueError(f"CHANGELOG.md has no line '## [{version}] - YYYY-MM-DD'")
    body = re.split(r"^## ", changelog[head.end() :], maxsplit=1, flags=re.MULTILINE)[0].strip()
    if not body:
        raise ValueError(f"CHANGELOG.md says nothing of {version}")
    return f"# Barsight {version}\n\n{body}\n"


def main() -> None:
    """Print the note, or one line that says why there is none."""
    if len(sys.argv) != 2:
        sys.exit("usage: python tools/release_note.py VERSION")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    try:
        sys.stdout.write(release_note(sys.argv[1], changelog, project["version"]))
    except ValueError as error:
        sys.exit(f"release_note: {error}")


if __name__ == "__main__":
    main()
