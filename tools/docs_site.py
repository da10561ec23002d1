"""Hook of MkDocs: the pages that are made from the code, the library's names and the HTTP interface."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

sys.path.insert(0, str(Path(__file__).parents[1]))

CLIENTS = ("app.client.Client",)
DEPTH = 4
"""How deep examples go into answers that hold answers (chosen)."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    pages = {"library": library(), "client": client(), "http": http()}
    files.append(File.generated(config, "index.md", content=front()))
    for name, text in pages.items():
        files.append(File.generated(config, f"reference/{name}.md", content=text))
    return files


def on_post_build(config: MkDocsConfig) -> None:
    """Let the search work from a folder too, see `docs_search.js`."""
    folder = Path(config.site_dir) / "search"
    index = json.loads((folder / "search_index.json").read_text(encoding="utf-8"))
    sections = json.dumps(index["docs"], ensure_ascii=False)
    (folder / "index.js").write_text(f"const searchedSections = {sections};\n", encoding="utf-8")
    (folder / "main.js").write_bytes(Path(__file__).with_name("docs_search.js").read_bytes())


def front() -> str:
    """The README as the first page: what it links to in this folder lies beside it."""
    text = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    return text.replace("](docs/", "](").replace('src="docs/', 'src="')


def library() -> str:
    """One section for each public name, in the order of its kind."""
    import lensmodel  # noqa: PLC0415 - only where a site is built

    names = [name for name in lensmodel.__all__ if getattr(lensmodel, name).__doc__]
    functions = sorted(name for name in names if name[0].islower())
    classes = sorted(name for name in names if name[0].isupper())
    parts = ["# Library", "The public names of `lensmodel`. [Library](../library.md) shows them at work.", ""]
    for name in [*functions, *classes]:
        value = getattr(lensmodel, name)
        home = getattr(value, "__module__", "lensmodel")
        if name in {"estimators", "selectors", "deconvolvers"}:
            parts += [
                f"## {name}",
                f"Registry of every {value.kind}: {', '.join(f'`{n}`' for n in value)}.",
                "",
            ]
            continue
        parts += [f"::: {home}.{name}", "    options:", "      heading_level: 2", ""]
    parts += ["::: lensmodel.core.registry.Registry", "    options:", "      heading_level: 2", ""]
    return "\n".join(parts)


def client() -> str:
    """The two clients of the service."""
    parts = ["# Client", "How they are used: [the service from Python](../topics/client.md).", ""]
    for name in CLIENTS:
        parts += [f"::: {name}", "    options:", "      heading_level: 2", ""]
    return "\n".join(parts)


def http() -> str:
    """Every call of the HTTP interface, from its own description, each with an example."""
    from app.main import create_app  # noqa: PLC0415 - as above

    document = create_app().openapi()
    schemas = document.get("components", {}).get("schemas", {})
    parts = [
        "# HTTP",
        "The calls of a running service, from its own description at `/openapi.json`; `/docs` there tries "
        "them out. Errors are `application/problem+json` with a fixed `code`.",
        "",
    ]
    for path, calls in document["paths"].items():
        for method, call in calls.items():
            parts += _call(method.upper(), path, call, schemas)
    return "\n".join(parts)


def _call(method: str, path: str, call: dict[str, Any], schemas: dict[str, Any]) -> list[str]:
    parts = [f"## {method} {path}", "", call.get("description") or call.get("summary", ""), ""]
    rows = [
        f"| `{p['name']}` | {p['in']} | {_kind(p.get('schema', {}), schemas)} | {p.get('description', '')} |"
        for p in call.get("parameters", [])
    ]
    if rows:
        parts += ["| parameter | in | kind | meaning |", "|---|---|---|---|", *rows, ""]
    body = call.get("requestBody", {}).get("content", {})
    sent = next(iter(body.items()), None)
    parts += ["```sh", _curl(method, path, call, sent, schemas), "```", ""]
    for status, answer in call.get("responses", {}).items():
        content = answer.get("content", {}).get("application/json")
        if status.startswith("2") and content and content.get("schema"):
            shown = json.dumps(example(content["schema"], schemas), indent=2, ensure_ascii=False)
            parts += [f"Answers {status}:", "", "```json", shown, "```", ""]
        elif status.startswith("2"):
            kinds = ", ".join(f"`{kind}`" for kind in answer.get("content", {}))
            parts += [f"Answers {status}{': ' + kinds if kinds else ', without a body'}.", ""]
    return parts


def _curl(
    method: str,
    path: str,
    call: dict[str, Any],
    sent: tuple[str, dict[str, Any]] | None,
    schemas: dict[str, Any],
) -> str:
    needed = [p for p in call.get("parameters", []) if p["in"] == "query" and p.get("required")]
    query = "&".join(f"{p['name']}={example(p.get('schema', {}), schemas)}" for p in needed)
    address = f"'http://127.0.0.1:8000{path}{'?' + query if query else ''}'"
    words = ["curl", *([] if method == "GET" else ["-X", method]), address]
    if sent is not None and sent[0] == "application/json":
        body = json.dumps(_required(sent[1].get("schema", {}), schemas))
        words += ["-H 'Content-Type: application/json'", f"-d '{body}'"]
    elif sent is not None and sent[0].startswith("multipart"):
        words.append("-F file=@p1.dng")
    return " ".join(words)


def _required(schema: dict[str, Any], schemas: dict[str, Any]) -> Any:  # noqa: ANN401 - JSON
    resolved = _resolved(schema, schemas)
    whole = example(schema, schemas)
    if not isinstance(whole, dict):
        return whole
    return {name: whole[name] for name in resolved.get("required", [])} or dict(list(whole.items())[:1])


def example(  # noqa: PLR0911 - one return for each kind of value
    schema: dict[str, Any], schemas: dict[str, Any], depth: int = 0
) -> Any:  # noqa: ANN401 - JSON
    """Make a value that a schema describes: its own example or default where it has one."""
    schema = _resolved(schema, schemas)
    for key in ("example", "const", "default"):
        if schema.get(key) is not None:
            return schema[key]
    if schema.get("examples"):
        return schema["examples"][0]
    if schema.get("enum"):
        return schema["enum"][0]
    kind = schema.get("type")
    if kind == "object" or "properties" in schema:
        if depth >= DEPTH:
            return {}
        return {name: example(of, schemas, depth + 1) for name, of in schema.get("properties", {}).items()}
    if kind == "array":
        return [] if depth >= DEPTH else [example(schema.get("items", {}), schemas, depth + 1)]
    if kind == "string" and schema.get("format") == "date-time":
        return "2026-11-01T12:00:00Z"
    least = schema.get("minimum", 0)
    return {"string": "string", "integer": max(int(least), 1), "number": float(least), "boolean": True}.get(
        kind
    )


def _resolved(schema: dict[str, Any], schemas: dict[str, Any]) -> dict[str, Any]:
    while "$ref" in schema:
        schema = schemas[schema["$ref"].rsplit("/", 1)[-1]]
    for key in ("anyOf", "oneOf", "allOf"):
        if key in schema and not any(name in schema for name in ("example", "examples")):
            known = [part for part in schema[key] if part.get("type") != "null"]
            if known:
                return {**_resolved(known[0], schemas), **{k: v for k, v in schema.items() if k == "default"}}
    return schema


def _kind(schema: dict[str, Any], schemas: dict[str, Any]) -> str:
    resolved = _resolved(schema, schemas)
    if resolved.get("enum"):
        return " or ".join(f"`{value}`" for value in resolved["enum"])
    return str(resolved.get("type", "any"))
