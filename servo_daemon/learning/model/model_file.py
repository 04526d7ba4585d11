"""Models on disk: a zip of `manifest.json`, for people and for every check, and `model.skops`, the learned numbers.

skops, not pickle: a file names the types it is made of, and what is not on the list below is refused before anything is
built from it; what is built is looked at (`checked.py`) before anything is asked of it. The hashes find damage and
careless editing; that this installation has made a file is told by a mark with its own key (`own_key.py`).
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from servo_daemon.errors import BadInputError
from servo_daemon.learning.examples.drawing import TrainingSpec
from servo_daemon.learning.examples.drive import same_rate
from servo_daemon.learning.examples.training import TARGETS
from servo_daemon.learning.features import catalogue
from servo_daemon.learning.learners.conformal import Intervals
from servo_daemon.learning.model.checked import check_parts
from servo_daemon.learning.model.manifest import (
    DIGITS,
    KIND,
    MANIFEST,
    NUMBERS,
    SCHEMA,
    check_versions,
    content_hash,
    spec_of,
    unpacked,
    versions,
)
from servo_daemon.learning.model.model import LearnedModel
from servo_daemon.learning.model.own_key import mark
from servo_daemon.plant.build import build_plant

#: Types a model may be made of, beside those that skops itself knows to be harmless.
_TYPES = frozenset(
    {
        "servo_daemon.learning.learners.grnn.GRNN",
        "servo_daemon.learning.features.preparation.Preparation",
        "servo_daemon.learning.learners.familiarity.Familiarity",
        "servo_daemon.learning.model.novelty.Novelty",
        "servo_daemon.learning.model.strangeness.Strangeness",  # its name in older files
        "servo_daemon.learning.learners.trees.BoostedTrees",
        "sklearn.tree._tree.Tree",
    }
)


@dataclass(frozen=True)
class DriveIdentity:
    """For which drive a model is.

    Attributes:
        effects, nominal, channels: of the drive, as in `TrainingSpec`.
        rate_hz: its sample rate; None: not known yet.
    """

    effects: tuple[str, ...]
    nominal: Mapping[str, float]
    channels: tuple[str, ...]
    rate_hz: float | None = None


def save_model(model: LearnedModel, path: Path) -> None:
    """Written beside and renamed, so that a file is whole or not there.

    Raises:
        BadInputError: it cannot be written there.
    """
    import skops.io

    parts = {
        "preparation": model.preparation,
        "kept": model.kept,
        "estimator": model.estimator,
        "familiarity": model.familiarity,
        "strangeness": model.novelty,  # the key of all files of this schema
        "intervals": {k: np.asarray(v) for k, v in asdict(model.intervals).items()},
    }
    numbers = skops.io.dumps(parts)
    manifest = _manifest(model, hashlib.sha256(numbers).hexdigest())
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as file:
            file.write(_packed(manifest, numbers))
            file.flush()
            os.fsync(file.fileno())
        Path(file.name).replace(path)
    except OSError as error:
        raise BadInputError(f"{path}: cannot be written: {error.strerror or error}") from error


def _packed(manifest: Mapping[str, Any], numbers: bytes) -> bytes:
    """The file: a zip whose comment is our mark and the hash of all bytes before them: none can change unnoticed."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(MANIFEST, json.dumps(manifest, indent=1, ensure_ascii=False))
        archive.writestr(NUMBERS, numbers)
        archive.comment = bytes(2 * DIGITS)
    content = packed.getvalue()[: -2 * DIGITS]
    content += mark(content)
    return content + hashlib.sha256(content).hexdigest().encode()


def _manifest(model: LearnedModel, numbers_sha256: str) -> dict[str, Any]:
    p, spec = model.preparation, model.spec
    names = [catalogue.NAMES[k] for k in p.used_]
    content: dict[str, Any] = {
        "kind": KIND,
        "schema": SCHEMA,
        "versions": versions(),
        "spec": asdict(spec) | {"nominal": dict(spec.nominal)},
        "plant": build_plant(spec.plant_effects).content_hash,
        "targets": list(TARGETS),
        "target": model.target,
        "learner": model.learner,
        "features": list(catalogue.NAMES),
        "features_kept": list(model.feature_names),
        # logarithms for positive features
        "ranges": {n: [float(p.points_[0, k]), float(p.points_[-1, k])] for k, n in enumerate(names)},
        "facts": dict(model.facts),
        "model_sha256": numbers_sha256,
    }
    return content | {"manifest_sha256": content_hash(content)}


def load_model(path: Path, drive: DriveIdentity | None = None, *, own: bool = False) -> LearnedModel:
    """A model from its file.

    Args:
        drive: for which it must have been trained; None: any.
        own: only if this installation has made it.

    Raises:
        BadInputError: the file is not a model, is damaged or altered, is made of types, shapes or values that no
            model is made of, was trained by other versions, for another drive, or (`own`) elsewhere; one line that
            says which.
    """
    manifest, numbers = unpacked(path, own)
    check_versions(path, manifest)
    spec = spec_of(path, manifest)
    if drive is not None:
        _check_drive(path, spec, drive)
    parts = _built(path, numbers)
    try:
        check_parts(parts, manifest["learner"])
    except BadInputError as error:
        raise BadInputError(f"{path}: refused: {error}") from error
    try:
        return LearnedModel(
            spec,
            manifest["target"],
            manifest["learner"],
            parts["preparation"],
            parts["kept"],
            parts["estimator"],
            Intervals(**parts["intervals"]),
            parts["familiarity"],
            parts["strangeness"],
            manifest["facts"],
        )
    except (KeyError, TypeError) as error:
        raise BadInputError(f"{path}: a part of the model is missing: {error}") from error


def _check_drive(path: Path, spec: TrainingSpec, drive: DriveIdentity) -> None:
    """Raises BadInputError where the model was trained for another one."""
    if spec.effects != drive.effects:
        ours, its = (", ".join(e) or "linear motor" for e in (drive.effects, spec.effects))
        raise BadInputError(f"{path}: trained for the model {its}, the drive has {ours}")
    if set(spec.channels) != set(drive.channels):
        have, had = ", ".join(drive.channels), ", ".join(spec.channels)
        raise BadInputError(f"{path}: trained for the signals {had}, the drive has {have}")
    for name, value in spec.nominal.items():
        if name in drive.nominal and not np.isclose(value, drive.nominal[name], rtol=1e-6):
            raise BadInputError(f"{path}: trained around {name} = {value:g}, the drive has {drive.nominal[name]:g}")
    if drive.rate_hz is not None and not same_rate(spec.rate_hz, drive.rate_hz):
        raise BadInputError(f"{path}: trained for {spec.rate_hz:g} Hz, the drive has {drive.rate_hz:g} Hz")


def _built(path: Path, numbers: bytes) -> dict[str, Any]:
    import skops.io

    try:
        foreign = sorted(set(skops.io.get_untrusted_types(data=numbers)) - _TYPES)
        if foreign:
            raise BadInputError(f"{path}: refused: it contains {', '.join(foreign[:3])}, which no model does")
        parts = skops.io.loads(numbers, trusted=sorted(_TYPES))
    except BadInputError:
        raise
    except Exception as error:  # whatever a file of somebody else's making runs into
        raise BadInputError(f"{path}: the model cannot be read: {error}") from error
    if not isinstance(parts, dict):
        raise BadInputError(f"{path}: not a model of servo-daemon")
    return parts
