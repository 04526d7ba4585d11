"""`deploy/sbom.py [FILE]`: a software bill of materials, CycloneDX 1.6 as JSON, of what requirements.lock installs.

Needs nothing but the standard library. The same lock gives the same bytes.
"""

from __future__ import annotations

import json
import re
import sys
import tomllib
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
#: A package of the lock: name, version, the condition under which it is installed, and a hash for each of its files.
_ENTRY = re.compile(
    r"^([a-z0-9._-]+)==([^\s;]+)(?: ; ([^\\\n]+))?((?:\s*\\\n\s+--hash=sha256:[0-9a-f]{64})+)", re.MULTILINE
)
_NAMESPACE = uuid.UUID("6ba7b811-9dad-11d1-80b4-00c04fd430c8")  # RFC 4122, appendix C: of URLs


def components(lock: str) -> Iterator[dict[str, Any]]:
    """One for each package, with its condition and the hashes of the files that pip accepts.

    Raises:
        ValueError: a line of the lock is none.
    """
    found = list(_ENTRY.finditer(lock))
    if len(found) != len(re.findall(r"^[^\s#]", lock, re.MULTILINE)):
        raise ValueError("requirements.lock: not every entry is NAME==VERSION with hashes")
    for name, version, marker, hashes in (match.groups() for match in found):
        properties = [{"name": "pip:sha256", "value": text} for text in re.findall(r"[0-9a-f]{64}", hashes)]
        if marker:
            properties.insert(0, {"name": "pip:marker", "value": marker.strip()})
        purl = f"pkg:pypi/{name}@{version}"
        yield {
            "type": "library",
            "bom-ref": purl,
            "name": name,
            "version": version,
            "purl": purl,
            "properties": properties,
        }


def bill(lock: str, project: dict[str, Any]) -> dict[str, Any]:
    """The document. `project` is the table of pyproject.toml."""
    parts = list(components(lock))
    own = f"pkg:pypi/{project['name']}@{project['version']}"
    licence = [{"license": {"id": project["license"]}}]
    return {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": f"urn:uuid:{uuid.uuid5(_NAMESPACE, own + lock)}",
        "version": 1,
        "metadata": {
            "component": {
                "type": "application", "bom-ref": own, "name": project["name"], "version": project["version"],
                "purl": own, "licenses": licence,
            }
        },
        "components": parts,
        # The lock says what is installed, not who asked for it.
        "dependencies": [{"ref": own, "dependsOn": [p["bom-ref"] for p in parts]}],
    }  # fmt: skip


def main() -> int:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    document = bill((ROOT / "requirements.lock").read_text(encoding="utf-8"), project)
    text = json.dumps(document, indent=1, ensure_ascii=False) + "\n"
    if len(sys.argv) > 1:
        Path(sys.argv[1]).parent.mkdir(parents=True, exist_ok=True)
        Path(sys.argv[1]).write_text(text, encoding="utf-8")
        print(f"{sys.argv[1]}: {len(document['components'])} packages")
    else:
        sys.stdout.write(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
