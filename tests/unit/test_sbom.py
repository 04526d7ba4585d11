"""The bill of materials: every package of the lock, in the form of CycloneDX 1.6."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import pytest

#: What CycloneDX 1.6 asks of the parts that are used here (ECMA-424, sections on bom, component, dependency and
#: property). Nothing else may be in the document.
_TEXT = {"type": "string", "minLength": 1}
_COMPONENT = {
    "type": "object",
    "required": ["type", "name", "version", "bom-ref", "purl"],
    "additionalProperties": False,
    "properties": {
        "type": {"enum": ["application", "library"]},
        "name": _TEXT,
        "version": _TEXT,
        "bom-ref": _TEXT,
        "purl": {"type": "string", "pattern": "^pkg:pypi/[a-z0-9-]+@[0-9A-Za-z.+!]+$"},
        "licenses": {
            "type": "array",
            "items": {"type": "object", "required": ["license"], "properties": {"license": {"required": ["id"]}}},
        },
        "properties": {
            "type": "array",
            "items": {"type": "object", "required": ["name"], "properties": {"name": _TEXT, "value": _TEXT}},
        },
    },
}
SCHEMA: dict[str, Any] = {
    "type": "object",
    "required": ["bomFormat", "specVersion", "components", "dependencies", "metadata"],
    "additionalProperties": False,
    "properties": {
        "$schema": {"const": "http://cyclonedx.org/schema/bom-1.6.schema.json"},
        "bomFormat": {"const": "CycloneDX"},
        "specVersion": {"const": "1.6"},
        "serialNumber": {"type": "string", "pattern": "^urn:uuid:[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}$"},
        "version": {"type": "integer", "minimum": 1},
        "metadata": {"type": "object", "properties": {"component": _COMPONENT}, "additionalProperties": False},
        "components": {"type": "array", "uniqueItems": True, "items": _COMPONENT},
        "dependencies": {
            "type": "array",
            "items": {"type": "object", "required": ["ref"], "properties": {"ref": _TEXT}},
        },
    },
}  # fmt: skip


def made(root: Path, *words: str) -> str:
    return subprocess.run(
        [sys.executable, "deploy/sbom.py", *words], cwd=root, capture_output=True, text=True, check=True
    ).stdout


def test_every_package_of_the_lock_is_in_it(repo_root: Path, tmp_path: Path) -> None:
    text = made(repo_root)
    document = json.loads(text)
    jsonschema.validate(document, SCHEMA)
    lock = (repo_root / "requirements.lock").read_text(encoding="utf-8")
    locked = re.findall(r"^([a-z0-9.-]+)==([^ ]+)", lock, re.MULTILINE)
    assert [(c["name"], c["version"]) for c in document["components"]] == locked
    hashes = [p["value"] for c in document["components"] for p in c["properties"] if p["name"] == "pip:sha256"]
    assert len(hashes) == lock.count("--hash=sha256:")
    refs = [c["bom-ref"] for c in document["components"]]
    assert len(set(refs)) == len(refs) and document["dependencies"][0]["dependsOn"] == refs
    made(repo_root, str(tmp_path / "sbom.json"))
    assert (tmp_path / "sbom.json").read_text(encoding="utf-8") == text, "the same lock, the same bytes"


def test_a_lock_with_a_line_of_another_kind_is_refused(repo_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(repo_root / "deploy"))
    import sbom

    entry = "a==1 \\\n    --hash=sha256:" + "0" * 64 + "\n"
    assert len(list(sbom.components(entry))) == 1
    with pytest.raises(ValueError, match="not every entry"):
        list(sbom.components(entry + "git+https://example.com/b\n"))
