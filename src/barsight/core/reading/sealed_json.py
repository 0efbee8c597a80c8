"""Read and write JSON documents that carry their own digest, so that changed ones are refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from barsight.core.errors import InputError
from barsight.core.files import atomic_path
from barsight.core.json_values import json_digest
from barsight.core.reading.bounded_reading import read_json

SEAL = "content_sha256"


def write_sealed(content: dict[str, Any], target: Path) -> str:
    """Write a document and its digest, completely or not at all; return the digest."""
    digest = json_digest(content)
    sealed = content | {SEAL: digest}
    text = ",\n".join(f"{json.dumps(name)}: {_lines(value)}" for name, value in sealed.items())
    with atomic_path(target) as path:
        path.write_text(f"{{\n{text}\n}}\n", encoding="utf-8")
    return digest


def _lines(value: Any) -> str:
    """Format a list with one item per line, for readers and diffs; full indentation is far slower."""
    if isinstance(value, list) and value:
        return "[\n " + ",\n ".join(json.dumps(item, allow_nan=False) for item in value) + "\n]"
    return json.dumps(value, allow_nan=False)


def read_sealed(path: Path, version: int, remedy: str) -> dict[str, Any]:
    """Read a document. Raises InputError if it is missing, damaged, of another version, or changed."""
    content = read_json(path, remedy)
    if not isinstance(content, dict) or "schema_version" not in content:
        raise InputError(path, "has no schema_version", remedy)
    found = content["schema_version"]
    if found != version:
        raise InputError(path, f"has schema version {found!r:.40} instead of {version}", remedy)
    document: dict[str, Any] = content
    inside = {key: value for key, value in document.items() if key != SEAL}
    if document.get(SEAL) != json_digest(inside):
        raise InputError(path, "was changed after it was written", remedy)
    return document
