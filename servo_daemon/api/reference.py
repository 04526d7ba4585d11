"""`/docs`: the OpenAPI document as a page, written here so that it needs no script and nothing from elsewhere."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from html import escape
from typing import Any

_HEAD = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}: the API</title><link rel="icon" href="assets/icon.svg">
<link rel="stylesheet" href="assets/reference.css">
</head><body><main>
<h1>{title} {version}: the API</h1>
"""
_TAIL = '<p>For programs: <a href="openapi.json">openapi.json</a>.</p>\n</main></body></html>\n'


def reference_page(document: Mapping[str, Any]) -> str:
    """The page `/docs` as HTML, from the OpenAPI document."""
    info = document["info"]
    head = _HEAD.format(title=escape(info["title"]), version=escape(info["version"]))
    operations = [(path, method, o) for path, item in document["paths"].items() for method, o in item.items()]
    index = "".join(
        f'<li><a href="#{_anchor(path, method)}"><b>{method.upper()}</b> <code>{escape(path)}</code></a> '
        f"{_text(_first_sentence(o))}</li>\n"
        for path, method, o in operations
    )
    shown = "".join("".join(_operation(document, path, method, o)) for path, method, o in operations)
    about = "".join(f"<p>{_text(part)}</p>\n" for part in info["description"].strip().split("\n\n"))
    return f"{head}{about}<nav aria-label='All requests'><ul>\n{index}</ul></nav>\n{shown}{_TAIL}"


def _anchor(path: str, method: str) -> str:
    return f"{method}-" + re.sub(r"[^a-z0-9]+", "-", path.lower()).strip("-")


def _first_sentence(operation: Mapping[str, Any]) -> str:
    text = str(operation.get("description", "")).strip().split("\n\n")[0].replace("\n", " ")
    return re.split(r"(?<=\.) |: (?=[^`]*(?:`[^`]*`[^`]*)*$)", text, maxsplit=1)[0]  # no colon inside `code`


def _text(text: str) -> str:
    """Plain text with `code`."""
    return re.sub(r"`([^`]*)`", r"<code>\1</code>", escape(" ".join(text.split()), quote=False))


def _operation(document: Mapping[str, Any], path: str, method: str, operation: Mapping[str, Any]) -> Iterator[str]:
    yield f'<section id="{_anchor(path, method)}"><h2><b>{method.upper()}</b> <code>{escape(path)}</code></h2>\n'
    for part in str(operation.get("description", "")).strip().split("\n\n"):
        yield f"<p>{_text(part)}</p>\n"
    if parameters := operation.get("parameters"):
        yield "<table><thead><tr><th>parameter</th><th>kind</th><th>means</th><th>such as</th></tr></thead><tbody>\n"
        for p in parameters:
            schema = p.get("schema", {})
            needed = "" if p.get("required") else ", optional" + _default(schema)
            kind = f"{_kind(schema)} in the {p['in']}{needed}"
            examples = ", ".join(str(e) for e in schema.get("examples", []))
            meaning = p.get("description") or schema.get("description", "")
            yield f"<tr><td><code>{escape(p['name'])}</code></td><td>{escape(kind)}</td>"
            yield f"<td>{_text(meaning)}</td><td><code>{escape(examples)}</code></td></tr>\n"
        yield "</tbody></table>\n"
    yield from _example(document, operation.get("requestBody", {}), "Body")
    for status, response in operation.get("responses", {}).items():
        yield f"<p><b>{escape(status)}</b> {_text(response.get('description', ''))}</p>\n"
        yield from _example(document, response, "For example")
    yield "</section>\n"


def _default(schema: Mapping[str, Any]) -> str:
    value = schema.get("default")
    return "" if value is None else f" ({value})"


def _kind(schema: Mapping[str, Any]) -> str:
    kinds = [s.get("type", "value") for s in schema.get("anyOf", [schema])]
    return " or ".join(kind for kind in kinds if kind != "null")


def _example(document: Mapping[str, Any], place: Mapping[str, Any], title: str) -> Iterator[str]:
    """Examples of what is sent or answered; those of problems are all alike and left out."""
    for media, content in place.get("content", {}).items():
        if "problem" in media:
            continue
        found = [content["example"]] if "example" in content else _model_examples(document, content.get("schema", {}))
        for example in found:
            shown = example if isinstance(example, str) else json.dumps(example, ensure_ascii=False, indent=1)
            yield f"<details><summary>{title}: <code>{escape(media)}</code></summary>"
            yield f'<pre tabindex="0">{escape(shown, quote=False)}</pre></details>\n'


def _model_examples(document: Mapping[str, Any], schema: Mapping[str, Any]) -> list[Any]:
    names = [s["$ref"].rpartition("/")[2] for s in schema.get("anyOf", [schema]) if "$ref" in s]
    return [e for name in names for e in document["components"]["schemas"][name].get("examples", [])]
