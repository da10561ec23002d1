"""Hook of MkDocs: the pages that are made from the code, the library's names and the HTTP interface."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

# Files outside the folder of the documents that README and pages point to
BESIDE = (
    *("CONTRIBUTING.md", "SECURITY.md", "LICENSE", "lensmodel/demo_data/README.md"),
    "app/pages/static/before-after.jpg",
)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    pages = {
        "index.md": beside("README.md"),
        "notebooks/index.md": notebooks(),
        "reference/library.md": library(),
        "reference/client.md": client(),
        "reference/http.md": http(),
        **{name: beside(name) for name in BESIDE},
    }
    for name, content in pages.items():
        files.append(File.generated(config, name, content=content))
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """Let links out of the folder of the documents lead to what `BESIDE` adds to it."""
    return markdown.replace("](../../lensmodel/", "](../lensmodel/")


def on_post_build(config: MkDocsConfig) -> None:
    """Let the search work from a folder too, see `docs_search.js`."""
    folder = Path(config.site_dir) / "search"
    index = json.loads((folder / "search_index.json").read_text(encoding="utf-8"))
    sections = json.dumps(index["docs"], ensure_ascii=False)
    (folder / "index.js").write_text(f"const searchedSections = {sections};\n", encoding="utf-8")
    (folder / "main.js").write_bytes(Path(__file__).with_name("docs_search.js").read_bytes())


def beside(name: str) -> str | bytes:
    """A file beside the folder of the documents; in the site the two are one."""
    path = ROOT / name
    if path.suffix not in {".md", ""}:
        return path.read_bytes()
    text = path.read_text(encoding="utf-8")
    return text.replace("](docs/notebooks)", "](notebooks/index.md)").replace("](docs/", "](")


def notebooks() -> str:
    """A page that lists the notebooks by their titles."""
    lines = ["# Notebooks", "Files for Jupyter, with what they printed.", ""]
    for path in sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")):
        title = json.loads(path.read_text(encoding="utf-8"))["cells"][0]["source"][0].strip("# \n")
        lines.append(f"- [{title}]({path.name})")
    return "\n".join(lines)


def shown(name: str) -> str:
    """What the docstring of a public name says, as a section."""
    return f"::: {name}\n    options:\n      heading_level: 2\n"


def library() -> str:
    """One section for each public name, functions before classes."""
    import lensmodel  # noqa: PLC0415 - only where a site is built
    from lensmodel.core.registry import Registry  # noqa: PLC0415 - same

    parts = ["# Library\nThe public names of `lensmodel`. [Library](../library.md) shows them at work.\n"]
    for name in sorted(lensmodel.__all__, key=lambda name: (name[0].isupper(), name)):
        value = getattr(lensmodel, name)
        if isinstance(value, Registry):
            every = ", ".join(f"`{each}`" for each in value)
            parts.append(f"## {name}\nRegistry of every {value.kind}: {every}.\n")
        elif value.__doc__:
            parts.append(shown(f"{getattr(value, '__module__', 'lensmodel')}.{name}"))
    return "\n".join([*parts, shown("lensmodel.core.registry.Registry")])


def client() -> str:
    """The client of the service."""
    about = "# Client\nHow it is used: [the service from Python](../topics/client.md).\n"
    return f"{about}\n{shown('app.client.Client')}"


def http() -> str:
    """Every call of the HTTP interface, from its own description."""
    from app.main import create_app  # noqa: PLC0415 - as above

    parts = [
        "# HTTP",
        "The calls of a running service, from its own description at `/openapi.json`, as `/docs` there shows "
        "them. Errors are `application/problem+json` with a fixed `code`.",
        "",
    ]
    for path, calls in create_app().openapi()["paths"].items():
        for method, call in calls.items():
            parts += [f"## {method.upper()} {path}", "", call.get("description") or call["summary"], ""]
            rows = [
                f"| `{p['name']}` | {p['in']} | {_type(p['schema'])} | {p.get('description', '')} |"
                for p in call.get("parameters", [])
            ]
            if rows:
                parts += ["| parameter | in | kind | meaning |", "|---|---|---|---|", *rows, ""]
            if "requestBody" in call:
                parts += [f"Body: {_kinds(call['requestBody'])}.", ""]
            answers = [
                f"{status} {_kinds(answer)}"
                for status, answer in call["responses"].items()
                if status.startswith("2")
            ]
            parts += [f"Answers {', '.join(answers)}.", ""]
    options = ["show_if_no_docstring", "show_signature_annotations"]
    parts += [
        "## Bodies",
        "",
        "::: app.schemas",
        "    options:",
        *(f"      {name}: true" for name in options),
    ]
    return "\n".join(parts)


def _type(schema: dict[str, Any]) -> str:
    return " or ".join(
        kind.get("type", "") for kind in schema.get("anyOf", [schema]) if kind != {"type": "null"}
    )


def _kinds(body: dict[str, Any]) -> str:
    """Media types of a body, and the name of its schema."""
    kinds = (
        f"`{kind}` {content.get('schema', {}).get('$ref', '').rpartition('/')[2]}".strip()
        for kind, content in body.get("content", {}).items()
    )
    return " or ".join(kinds) or "without a body"
