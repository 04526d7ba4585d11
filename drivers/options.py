"""The `[drive.options]` of a driver, checked against a pydantic model."""

from __future__ import annotations

from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from servo_daemon.errors import DriverConfigError

#: Of every model of options: unknown keys are refused, nothing is converted.
STRICT = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

Options = TypeVar("Options", bound=BaseModel)


def checked(model: type[Options], name: str, options: dict[str, Any]) -> Options:
    """The options of drive `name` as the model has them.

    Raises:
        DriverConfigError: one line that names the drive and the option.
    """
    try:
        return model.model_validate(options)
    except ValidationError as error:
        complaints = error.errors()  # a misspelt option before the one it leaves missing
        first = next((e for e in complaints if e["type"] == "extra_forbidden"), complaints[0])
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            known = ", ".join(model.model_fields)
            raise DriverConfigError(f"drive {name}: unknown option '{key}': known are {known}") from error
        message = first["msg"].removeprefix("Value error, ")
        where = f"option '{key}': " if key else ""
        raise DriverConfigError(f"drive {name}: {where}{message}") from error
