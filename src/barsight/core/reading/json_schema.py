"""Check a JSON document against a schema, by the keywords that the package's own schemas use.

type, const, enum, anyOf, $ref; properties, required, additionalProperties; items, minItems, maxItems;
minimum, exclusiveMinimum, maximum [JSON Schema 2020-12].
"""

from __future__ import annotations

import json
import math
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from barsight.core.errors import InputError

_TYPES: dict[str, tuple[type, ...]] = {
    "object": (dict,), "array": (list,), "string": (str,), "boolean": (bool,), "null": (type(None),),
    "integer": (int,), "number": (int, float),
}  # fmt: skip


@cache
def package_schema(package: str, name: str) -> Any:
    """Load a schema from a package's folder `schemas`."""
    text = resources.files(package).joinpath("schemas", f"{name}.schema.json").read_text(encoding="utf-8")
    return json.loads(text)


def record_schema(**fields: Any) -> dict[str, Any]:
    """Make the schema of an object that has exactly these fields."""
    return {"type": "object", "required": list(fields), "properties": fields, "additionalProperties": False}


def list_schema(items: Any) -> dict[str, Any]:
    """Make the schema of a list."""
    return {"type": "array", "items": items}


def expect_schema(document: Any, schema: Any, path: Path | str, remedy: str) -> None:
    """Raise InputError about `path`, naming the first place where the document violates the schema."""
    fault = _fault(document, schema, schema, "")
    if fault:
        raise InputError(path, f"isn't as its schema says ({fault})", remedy)


def _fault(value: Any, node: dict[str, Any], root: dict[str, Any], where: str) -> str:
    """Describe the first violation; empty if there is none."""
    if "$ref" in node:
        found: Any = root
        for key in node["$ref"].removeprefix("#/").split("/"):
            found = found[key]
        return _fault(value, found, root, where)
    if "anyOf" in node:
        faults = [_fault(value, choice, root, where) for choice in node["anyOf"]]
        return "" if "" in faults else faults[0]
    if "const" in node and value != node["const"]:
        return f"{where} is {_short(value)}, not {node['const']}"
    if "enum" in node and value not in node["enum"]:
        return f"{where} is {_short(value)}, which it can't be"
    if "type" in node and type(value) not in _kinds(node):
        return f"{where or 'it'} is {_short(value)}, not {node['type']}"
    if isinstance(value, dict):
        return _object_fault(value, node, root, where)
    if isinstance(value, list):
        return _list_fault(value, node, root, where)
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return _number_fault(value, node, where)
    return ""


def _kinds(node: dict[str, Any]) -> tuple[type, ...]:
    names = node["type"] if isinstance(node["type"], list) else [node["type"]]
    return tuple(kind for name in names for kind in _TYPES[name])


def _object_fault(value: dict[str, Any], node: dict[str, Any], root: dict[str, Any], where: str) -> str:
    properties = node.get("properties", {})
    for name in node.get("required", ()):
        if name not in value:
            return f"{where}.{name} is missing"
    more = node.get("additionalProperties", True)
    for name, item in value.items():
        if name not in properties and more is False:
            return f"{where}.{name[:40]} is unknown"
        part = properties.get(name, more)
        fault = _fault(item, part, root, f"{where}.{name}") if isinstance(part, dict) else ""
        if fault:
            return fault
    return ""


def _list_fault(value: list[Any], node: dict[str, Any], root: dict[str, Any], where: str) -> str:
    if not node.get("minItems", 0) <= len(value) <= node.get("maxItems", math.inf):
        return f"{where} has {len(value)} items"
    items = node.get("items")
    if not isinstance(items, dict):
        return ""
    if items.keys() == {"type"}:
        # Tables of figures are long.
        kinds = _kinds(items)
        if all(type(item) in kinds for item in value) and math.inf not in value and -math.inf not in value:
            return ""
    for k, item in enumerate(value):
        if fault := _fault(item, items, root, f"{where}[{k}]"):
            return fault
    return ""


def _number_fault(value: float, node: dict[str, Any], where: str) -> str:
    low, over, high = node.get("minimum"), node.get("exclusiveMinimum"), node.get("maximum")
    can_be = (
        (low is None or value >= low) and (over is None or value > over) and (high is None or value <= high)
    )
    if can_be and abs(value) < MAX_FIGURE:
        return ""
    return f"{where} is {_short(value)}, which it can't be"


MAX_FIGURE = 2**63
"""Maximum magnitude of a number: time stamps in ns are the largest."""


def _short(value: Any) -> str:
    if isinstance(value, (dict, list)):
        return "a list" if isinstance(value, list) else "an object"
    return json.dumps(value)[:40]
