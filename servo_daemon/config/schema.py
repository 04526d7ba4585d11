"""The JSON schema of a configuration file, for editors: from the same sections and tables that check it."""

from __future__ import annotations

import re
from typing import Any, Final

from pydantic.json_schema import GenerateJsonSchema

from servo_daemon.config.section import NAME
from servo_daemon.config.sections import Config
from servo_daemon.config_texts import DRIFT, RELATIVE, SPAN
from servo_daemon.parameters import J_D, Parameter, spaced
from servo_daemon.plant.effects import effects_by_name, parameter_table

#: The dialect that pydantic writes; taplo and VS Code read it.
DIALECT: Final = GenerateJsonSchema.schema_dialect


def json_schema(drivers: tuple[str, ...]) -> dict[str, Any]:
    """Of the whole file.

    Args:
        drivers: known ones, which an editor offers; others may be installed where the file is used.
    """
    schema = {"$schema": DIALECT, **Config.model_json_schema(), "title": "servo-daemon configuration"}
    sections = schema["$defs"]
    for section in (schema, *sections.values()):
        _tidy(section)
    drive = sections["DriveConfig"]["properties"]
    table = parameter_table()
    drive["name"] |= {"pattern": f"^{NAME.pattern}$"}
    drive["driver"] = {"default": "simulated", "anyOf": [{"enum": list(drivers)}, {"type": "string"}]}
    drive["model"]["items"] = {"oneOf": [{"const": e.name, "description": e.cause} for e in effects_by_name().values()]}
    nominal = {"from": {"type": "string", "description": "fleet.parquet: what drives of this type have in common"}}
    nominal |= {n: _nominal(p) for n, p in table.items()}
    drive["nominal"] = _closed("What the datasheet says, SI units.", nominal)
    drift = {"type": "string", "pattern": _whole(DRIFT)}
    drive["drift"] = _closed("1 σ of its change, such as 10 %/h.", {name: _of(p, drift) for name, p in table.items()})
    limits = sections["LimitsConfig"]
    limits["additionalProperties"] = False
    limits["properties"]["warn_before"] |= {"pattern": _whole(SPAN)}
    limits["properties"] |= _alarms({**table, J_D.name: J_D})
    return schema


def _whole(pattern: re.Pattern[str]) -> str:
    return f"^{pattern.pattern}$"


def _closed(description: str, properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "description": description, "properties": properties, "additionalProperties": False}


def _of(p: Parameter, schema: dict[str, Any]) -> dict[str, Any]:
    return {"description": f"{p.description}{spaced(p.unit)}", **schema}


def _nominal(p: Parameter) -> dict[str, Any]:
    number = {"type": "number", "minimum": p.lower, "maximum": p.upper}
    return _of(p, {"anyOf": [number, {"enum": list(p.choices)}]} if p.choices else number)


def _alarms(table: dict[str, Parameter]) -> dict[str, Any]:
    limit = {"type": ["number", "string"], "pattern": _whole(RELATIVE)}
    return {
        f"{name}_{side}": {"description": f"An alarm: {p.description} {where}{spaced(p.unit)}", **limit}
        for name, p in table.items()
        for side, where in (("max", "above this"), ("min", "below this"))
    }


def _tidy(section: dict[str, Any]) -> None:
    """Without titles that only repeat the key, without null, which TOML has not (such a key is left out), and without
    whole sections as defaults: each of their keys has its own."""
    for key, schema in section.get("properties", {}).items():
        given = [one for one in schema.get("anyOf", ()) if one != {"type": "null"}]
        alone = given[0] if len(given) == 1 else {}
        left = {"title", *(("anyOf",) if alone else ()), *(() if _is_plain(schema.get("default")) else ("default",))}
        section["properties"][key] = {k: v for k, v in {**schema, **alone}.items() if k not in left}


def _is_plain(default: Any) -> bool:
    parts = default if isinstance(default, list) else [default]
    return not any(part is None or isinstance(part, dict) for part in parts)
