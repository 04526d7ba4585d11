"""What a model's file says of itself, for every check that needs no scikit-learn: loading that takes a second."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import zipfile
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from servo_daemon import __version__
from servo_daemon.errors import BadInputError
from servo_daemon.learning import LEARNERS
from servo_daemon.learning.examples.drawing import TrainingSpec
from servo_daemon.learning.examples.targets import TARGET_KINDS
from servo_daemon.learning.examples.training import TARGETS
from servo_daemon.learning.features import catalogue
from servo_daemon.learning.model.own_key import is_ours
from servo_daemon.plant.build import build_plant

log = logging.getLogger(__name__)

#: Raised when what a file holds means something else.
SCHEMA = 5
KIND = "servo-daemon learned model"
MANIFEST, NUMBERS = "manifest.json", "model.skops"
#: No model is larger, bytes; a zip can promise anything.
_LARGEST = 500_000_000
#: Of a SHA-256 hash, as text.
DIGITS = 64


def versions() -> dict[str, str]:
    return {
        "servo_daemon": __version__,
        "features": str(catalogue.VERSION),
        "scikit-learn": ".".join(version("scikit-learn").split(".")[:2]),
    }


def content_hash(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True, ensure_ascii=False).encode()).hexdigest()


def trained_as(path: Path) -> tuple[TrainingSpec, str]:
    """On what a model of our own was trained, and which learner it is; its numbers are not built.

    Raises:
        BadInputError: see `load_model`.
    """
    manifest, _ = unpacked(path, own=True)
    check_versions(path, manifest)
    return spec_of(path, manifest), str(manifest["learner"])


def unpacked(path: Path, own: bool) -> tuple[dict[str, Any], bytes]:
    try:
        packed = path.read_bytes()
    except OSError as error:
        raise BadInputError(f"{path}: cannot be read: {error.strerror or error}") from error
    try:
        with zipfile.ZipFile(io.BytesIO(packed)) as archive:
            if sum(i.file_size for i in archive.infolist()) > _LARGEST:
                raise BadInputError(f"{path}: larger than any model")
            manifest, numbers = json.loads(archive.read(MANIFEST)), archive.read(NUMBERS)
    except BadInputError:
        raise
    except Exception as error:  # a byte that has changed leads anywhere: into zlib, a wrong offset, a password
        raise BadInputError(f"{path}: not a model of servo-daemon, or damaged: {error}") from error
    if not isinstance(manifest, dict) or manifest.get("kind") != KIND:
        raise BadInputError(f"{path}: not a model of servo-daemon")
    if manifest.get("schema") != SCHEMA:
        raise BadInputError(f"{path}: a model of schema {manifest.get('schema')}, here is {SCHEMA}: train it again")
    content = {k: v for k, v in manifest.items() if k != "manifest_sha256"}
    if manifest.get("manifest_sha256") != content_hash(content):
        raise BadInputError(f"{path}: its manifest has been altered: the content hash does not match")
    if manifest.get("model_sha256") != hashlib.sha256(numbers).hexdigest():
        raise BadInputError(f"{path}: the model has been altered: the content hash does not match")
    if packed[-DIGITS:] != hashlib.sha256(packed[:-DIGITS]).hexdigest().encode():
        raise BadInputError(f"{path}: the file has been altered: its hash does not match")
    if not is_ours(packed[: -2 * DIGITS], packed[-2 * DIGITS : -DIGITS]):
        if own:
            raise BadInputError(f"{path}: not made by this installation: not used unless it is named with --model")
        log.info("%s: made by another installation: whether it is a model is checked, not who made it", path)
    return manifest, numbers


def check_versions(path: Path, manifest: Mapping[str, Any]) -> None:
    here, there = versions(), manifest.get("versions", {})
    # Another version of the program is fine as long as features and equations are the same.
    for name in ("features", "scikit-learn"):
        if there.get(name) != here[name]:
            raise BadInputError(f"{path}: trained with {name} {there.get(name)}, here is {here[name]}: train it again")
    if manifest.get("features") != list(catalogue.NAMES) or manifest.get("targets") != list(TARGETS):
        raise BadInputError(f"{path}: trained on other features than this version computes: train it again")
    if manifest.get("target") not in TARGET_KINDS or manifest.get("learner") not in LEARNERS:
        raise BadInputError(f"{path}: its target or learner is none of this version's: train it again")


def spec_of(path: Path, manifest: Mapping[str, Any]) -> TrainingSpec:
    try:
        table = dict(manifest["spec"])
        table |= {name: tuple(table[name]) for name in ("effects", "channels")}
        spec = TrainingSpec(**table)
        plant = build_plant(spec.plant_effects).content_hash
    except (KeyError, TypeError, BadInputError) as error:
        raise BadInputError(f"{path}: what it was trained on cannot be read: {error}") from error
    if manifest.get("plant") != plant:
        raise BadInputError(f"{path}: trained on other equations of the motor than this version's: train it again")
    return spec
