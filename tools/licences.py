"""Write docs/licences.md from the installed packages' metadata: `python tools/licences.py`.

The packages are those that pyproject.toml names at run time and in the extras for users, and what they need.
"""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Iterable
from importlib.metadata import distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "licences.md"
EXTRAS = (
    "view", "export", "bench", "notebook", "store", "page", "postgres", "fleet", "acceptance", "cameras",
    "labels", "numbers", "opcua", "mqtt", "s7", "signing",
)  # fmt: skip
_HEAD = """# Licences

Barsight is under the Apache License 2.0 (`LICENSE`). Neither its repository nor its wheel holds code of
others; pip installs the packages below beside it, each under its own licence. `python tools/licences.py`
writes this page from the installed packages' metadata, and a test holds that none of them is under
the GPL or AGPL.

Some wheels bundle libraries: NumPy's and SciPy's for Linux OpenBLAS (BSD-3-Clause) and libgfortran (GPL-3.0
with the GCC Runtime Library Exception), OpenCV's FFmpeg (LGPL-2.1). Whoever passes these wheels on passes
the libraries on too; their licences lie in the wheels' `.dist-info` folders.

The extra `basler` is not listed: it installs pypylon, whose wheel holds Basler's pylon under Basler's own
licence (in its `.dist-info` folder); read it before you use it or pass it on. Nor is `mitsuba`, which
no lock holds: Mitsuba 3 and Dr.Jit are under BSD-3-Clause.

GTSAM's wheel declares that it needs pytest, so pytest's packages are listed under Run time;
`requirements.lock` leaves them out.
"""


def packages(requirements: Iterable[str]) -> set[str]:
    """Collect the names of all installed packages that the requirements lead to."""
    found: set[str] = set()
    asked: set[tuple[str, str]] = set()
    queue = [Requirement(text) for text in requirements]
    while queue:
        requirement = queue.pop()
        name = canonicalize_name(requirement.name)
        found.add(name)
        for extra in {"", *requirement.extras} - {extra for known, extra in asked if known == name}:
            asked.add((name, extra))
            for text in distribution(name).requires or []:
                needed = Requirement(text)
                if needed.marker is None or needed.marker.evaluate({"extra": extra}):
                    queue.append(needed)
    return found


def licence(package: str) -> str:
    """Read a package's licence: its SPDX expression, else its classifiers, else its metadata's first line."""
    metadata = distribution(package).metadata
    if "License-Expression" in metadata:
        return metadata["License-Expression"]
    classifiers = metadata.get_all("Classifier") or []
    named = [text.split(" :: ")[-1] for text in classifiers if text.startswith("License :: ")]
    named = [text for text in named if text != "OSI Approved"]
    first = metadata["License"].strip().splitlines()[:1] if "License" in metadata else []
    return ", ".join(named or first) or "not stated"


def sections() -> dict[str, list[str]]:
    """List the packages of the run time and, less those, of each extra for users."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    base = packages(project["dependencies"])
    extras = project["optional-dependencies"]
    return {"": sorted(base)} | {name: sorted(packages(extras[name]) - base) for name in EXTRAS}


def page() -> str:
    """Format the page."""
    parts = [_HEAD]
    for extra, names in sections().items():
        parts.append(f"## {f'Extra `{extra}`' if extra else 'Run time'}\n\n| package | licence |\n|---|---|")
        parts[-1] += "".join(f"\n| {name} | {licence(name)} |" for name in names) + "\n"
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    sys.stdout.write(f"written: {PAGE}\n")
