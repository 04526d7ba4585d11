"""Knowledge kept over a restart: one small JSON file a drive, replaced atomically, checked on load, never fatal.

A file is used only if schema, drive identity and model are the same and every value is inside its bounds. The model is
the configuration's, or one that was adopted while the configuration said what it says now. A broken file is set aside
(renamed to `*.bad`) and said. Power just disappears, so the file is written every few seconds.
"""

from __future__ import annotations

import json
import logging
import math
import os
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from servo_daemon.errors import ModelError
from servo_daemon.kalman.gaussian import to_coordinate
from servo_daemon.pipeline.model_change import checked_request
from servo_daemon.pipeline.publish import Adopted, SavedState
from servo_daemon.plant.effects import parameter_table

log = logging.getLogger(__name__)

#: Raise when the meaning of the file changes; older files are then set aside.
SCHEMA_VERSION = 1


class StateFile:
    """The state file of one drive.

    Args:
        directory: where state files are; None: nothing is kept.
        drive: the drive's name, part of the file's name.
    """

    def __init__(self, directory: Path | None, drive: str) -> None:
        self._path = None if directory is None else directory / f"{drive}.state.json"
        self._complained = False

    def load(self, identity: str, model: tuple[str, ...]) -> SavedState | None:
        """What was saved for this device and model; None without a usable file.

        Args:
            model: as it is configured now. Where it was configured like this before, too, a model that was adopted
                since stands in its place; where the user has changed it, the adopted one is forgotten.
        """
        text = self._text()
        if text is None:
            return None
        try:
            data = json.loads(text)
            if data["schema"] != SCHEMA_VERSION:
                raise ValueError(f"schema {data['schema']}, this version reads {SCHEMA_VERSION}")
            adopted = "adopted" in data and tuple(data["adopted"]["configured"]) == model
            if data["identity"] != identity or (tuple(data["model"]) != model and not adopted):
                log.info("%s is of another device or model (%s): not used", self._path, data["identity"])
                return None
            saved = _checked(data)
            return saved if adopted else replace(saved, adopted=None)
        except (ValueError, KeyError, TypeError, ArithmeticError, RecursionError) as error:  # whatever JSON may hold
            self._set_aside(f"{type(error).__name__}: {error}")
            return None

    def _text(self) -> str | None:
        """The file's text; None (said, unless it just is not there) if it cannot be had."""
        try:
            return None if self._path is None else self._path.read_text(encoding="utf-8")
        except (FileNotFoundError, NotADirectoryError):  # the second is told when it cannot be written either
            return None
        except UnicodeDecodeError:
            self._set_aside("not a text file")
        except OSError as error:
            log.warning("%s: cannot be read: %s", self._path, error.strerror or error)
        return None

    def save(self, identity: str, state: SavedState) -> bool:
        """Replace the file atomically. False (and one log line) if it cannot be written; True where none is kept."""
        if self._path is None:
            return True
        document: dict[str, object] = {
            "schema": SCHEMA_VERSION,
            "identity": identity,
            "model": list(state.model),
            "names": list(state.names),
            "mean": list(state.mean),
            "covariance": [list(row) for row in state.covariance],
        }
        if state.adopted is not None:
            document["adopted"] = {
                "configured": list(state.adopted.configured),
                "nominal": dict(state.adopted.nominal),
            }
        try:
            _replace(self._path, json.dumps(document, allow_nan=False, indent=1))
        except OSError as error:
            if not self._complained:
                log.warning("%s: state cannot be kept: %s", self._path, error.strerror or error)
                self._complained = True
            return False
        self._complained = False
        return True

    def forget(self) -> None:
        """Delete the file, as after a reset by the user."""
        if self._path is not None:
            try:
                self._path.unlink(missing_ok=True)
            except OSError as error:
                log.warning("%s: cannot be deleted: %s", self._path, error.strerror or error)

    def _set_aside(self, why: str) -> None:
        assert self._path is not None
        bad = self._path.with_suffix(".bad")
        try:
            self._path.replace(bad)
            log.warning("%s is unusable (%s): set aside as %s", self._path, why, bad.name)
        except OSError as error:
            log.warning("%s is unusable (%s) and cannot be set aside: %s", self._path, why, error.strerror or error)


def _checked(data: dict[str, Any]) -> SavedState:
    """The file's content as a state.

    Raises:
        ValueError, KeyError, TypeError: anything in it is impossible.
    """
    names = tuple(str(n) for n in data["names"])
    mean = np.array(data["mean"], dtype=float)
    covariance = np.array(data["covariance"], dtype=float)
    model = tuple(str(m) for m in data["model"])
    adopted = _adopted(data, model)
    n = len(names)
    if n == 0 and adopted is not None:  # the model alone
        return SavedState(model, (), (), (), adopted)
    if n == 0 or len(set(names)) != n:
        raise ValueError(f"names {list(names)}")
    if mean.shape != (n,) or covariance.shape != (n, n):
        raise ValueError(f"{n} names, mean {mean.shape}, covariance {covariance.shape}")
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        raise ValueError("not finite")
    table = parameter_table()
    for name, value in zip(names, mean, strict=True):
        p = table[name]
        if not to_coordinate(p, p.lower) <= value <= to_coordinate(p, p.upper):
            raise ValueError(f"{name} is outside {p.lower:g} .. {p.upper:g}")
    if not np.allclose(covariance, covariance.T) or np.linalg.eigvalsh(covariance).min() < -1e-12:
        raise ValueError("the covariance is not symmetric positive semi-definite")
    if float(np.sqrt(np.diag(covariance).max(initial=0.0))) > math.log(100.0):
        raise ValueError("the covariance says nothing is known")
    return SavedState(model, names, tuple(mean.tolist()), tuple(tuple(row) for row in covariance.tolist()), adopted)


def _adopted(data: dict[str, Any], model: tuple[str, ...]) -> Adopted | None:
    """What the file says of a model that was adopted, checked like one that is asked for.

    Raises:
        ValueError, KeyError, TypeError: it is impossible.
    """
    if "adopted" not in data:
        return None
    nominal = {str(name): (float(value), None) for name, value in dict(data["adopted"]["nominal"]).items()}
    try:
        checked_request(model, nominal)
    except ModelError as error:
        raise ValueError(str(error)) from None
    configured = tuple(str(m) for m in data["adopted"]["configured"])
    return Adopted(configured, {name: value for name, (value, _) in nominal.items()})


def _replace(path: Path, text: str) -> None:
    """Write beside, flush to the disk, rename, flush the directory: whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.name, suffix=".tmp")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    directory = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)
