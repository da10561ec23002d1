"""The description of the HTTP interface for people."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Operation:
    """One operation of the interface."""

    method: str
    path: str
    summary: str
    description: str
    parameters: list[tuple[str, str, str]]
    """Name, location and meaning of each."""

    body: list[str]
    answers: list[str]


def operations(described: Mapping[str, Any]) -> list[tuple[str, list[Operation]]]:
    """Return the operations of an OpenAPI document by their first tag, in its order."""
    groups: defaultdict[str, list[Operation]] = defaultdict(list)
    for path, methods in described["paths"].items():
        for method, entry in methods.items():
            groups[(entry.get("tags") or ["other"])[0]].append(_operation(method, path, entry))
    return list(groups.items())


def _operation(method: str, path: str, entry: Mapping[str, Any]) -> Operation:
    listed = entry.get("parameters", [])
    return Operation(
        method=method.upper(),
        path=path,
        summary=entry["summary"],
        description=entry.get("description", ""),
        parameters=[(p["name"], p["in"], _meaning(p)) for p in listed],
        body=list(entry.get("requestBody", {}).get("content", {})),
        answers=[f"{status} {answer['description']}" for status, answer in entry["responses"].items()],
    )


def _meaning(parameter: Mapping[str, Any]) -> str:
    schema = parameter.get("schema", {})
    description = parameter.get("description") or schema.get("description", "")
    choice = f"one of {', '.join(map(str, schema['enum']))}" if "enum" in schema else ""
    default = f"default {schema['default']}" if schema.get("default") is not None else ""
    return "; ".join(part for part in (description, choice, default) if part)
