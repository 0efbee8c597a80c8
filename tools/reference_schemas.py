"""JSON Schemas of the package as tables, one row a property."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any


def schemas_page(package: Path) -> str:
    """A section for each `*.schema.json` below `package`."""
    lines = ["# JSON Schemas\n\n[Result files](results.md) says what the figures mean.\n"]
    for path in sorted(package.rglob("*.schema.json")):
        schema = json.loads(path.read_text(encoding="utf-8"))
        lines.append(f"\n## {path.name.replace('.schema', '')}\n\n{schema.get('description', '')}\n\n")
        lines.append(f"The schema is `{path.relative_to(package.parent)}`.\n\n")
        lines.append("| property | type | meaning |\n|---|---|---|\n")
        rows = _rows(schema, schema, "", {})
        lines += [f"| `{name}` | {kind} | {about} |\n" for name, kind, about in rows]
    return "".join(lines)


def _rows(
    node: dict[str, Any], root: dict[str, Any], prefix: str, seen: dict[str, str]
) -> Iterator[tuple[str, str, str]]:
    """seen: the property that first had each definition; a later one refers to it."""
    for name, stated in node.get("properties", {}).items():
        part, dotted = _resolved(stated, root), f"{prefix}{name}"
        items: dict[str, Any] = part["items"] if isinstance(part.get("items"), dict) else {}
        shared = _reference(items) or _reference(stated)
        first = seen.setdefault(shared, dotted) if shared else dotted
        like = "" if first == dotted else f"as `{first}`"
        about = part.get("description", "").replace("|", "\\|")
        choices = stated.get("oneOf", stated.get("anyOf", []))
        null = " or null" * any(one.get("type") == "null" for one in choices)
        yield dotted, _type(part, root) + null, "; ".join(filter(None, (about, like)))
        if not like:
            yield from _rows(part, root, f"{dotted}.", seen)
            yield from _rows(_resolved(items, root), root, f"{dotted}[].", seen)


def _reference(node: dict[str, Any]) -> str | None:
    """The definition that a node or one of its choices names."""
    found = [one["$ref"] for one in (node, *node.get("anyOf", []), *node.get("oneOf", [])) if "$ref" in one]
    return found[0] if found else None


def _resolved(node: dict[str, Any], root: dict[str, Any]) -> dict[str, Any]:
    """The node that `$ref` names, with what stands beside the reference; the object of a choice with null."""
    for choice in node.get("anyOf", []) + node.get("oneOf", []):
        if choice.get("type") != "null":
            return _resolved(choice, root) | {k: v for k, v in node.items() if k not in ("anyOf", "oneOf")}
    if "$ref" not in node:
        return node
    found = root
    for key in node["$ref"].removeprefix("#/").split("/"):
        found = found[key]
    return _resolved(found, root) | {k: v for k, v in node.items() if k != "$ref"}


def _type(node: dict[str, Any], root: dict[str, Any]) -> str:
    if "const" in node:
        return f"`{json.dumps(node['const'])}`"
    if "enum" in node:
        named = ", ".join(f"`{value}`" for value in node["enum"])
        return named if len(node["enum"]) < 6 else "[code](codes.md#vetoes)"
    kinds = node.get("type", "object")
    said = " or ".join(kinds) if isinstance(kinds, list) else kinds
    if isinstance(node.get("items"), dict) and "array" in said:
        said += f" of {_type(_resolved(node['items'], root), root)}"
    return said
