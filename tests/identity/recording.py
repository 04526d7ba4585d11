"""Hashes of what `replay`, `fit`, `compare`, `diagnose` and `tune` answer about a few short captures.

The captures differ in their channels and rates: simulated ones, and real ones where there are any. Times that a
command took and figures drawn for the eye are left out. Floating-point results differ between processors and versions
of the numerical libraries, so the references say on what they were made.
"""

from __future__ import annotations

import contextlib
import csv
import hashlib
import json
import platform
import re
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from tests.command_line import run_command

#: Samples handed to the pipeline at once; the last is more than any capture has.
BLOCKS = (1, 7, 64, 1_000_000)
#: Real captures (folder `servo_data`): of a brushed motor, of a geared hobby servo, of a FOC drive.
REAL = ("unal_prbs", "xl330_up_and_down_kp100", "odrive_spinup_comp_25")
#: What of a JSON document depends on the machine's speed.
_TIMES = frozenset({"seconds", "created", "time"})
#: … and of a text: "trained now, in 31 s, and kept".
_SECONDS = re.compile(r", in \d+ s\b")

_CONFIG = """[[drive]]
name = "axis1"
driver = "simulated"
model = ["coulomb_friction"]
[drive.nominal]
R = 0.4937
L = 2.2769e-3
K = 0.30628
J = 0.009751
B = 0.51141
Tc = 0.02
[drive.limits]
voltage_V = 24.0
[drive.estimation]
engine = "{engine}"
"""

Recording = dict[str, Any]


def record(folder: Path, data: Path | None) -> Recording:
    """Runs everything in `folder`, which must be empty.

    Args:
        data: the folder of real captures; without it those are left out.
    """
    models = mock.patch("servo_daemon.learning.model.cache.cache_directory", lambda: folder)  # no model of another day
    with contextlib.chdir(folder), models:
        answers = dict(_answers(_captures(data)))
    return {"machine": machine(), "answers": answers}


def machine() -> dict[str, str]:
    """On what two recordings must agree before their numbers can be compared."""
    libraries = {name: version(name) for name in ("numpy", "scipy", "casadi", "scikit-learn")}
    features = json.dumps(np.show_config(mode="dicts"), sort_keys=True, default=str)
    return {
        **libraries,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "numpy_build": _hash(features),
    }


def references(path: Path) -> Recording:
    """The recording to compare with."""
    return dict(json.loads(path.read_text()))


def differences(wanted: Recording, found: Recording) -> list[str]:
    """Answers that are not the same, by name; those about real captures only where both recordings have them."""
    one, other = wanted["answers"], found["answers"]
    return sorted(name for name in one.keys() & other.keys() if one[name] != other[name])


def _captures(data: Path | None) -> dict[str, Path]:
    """Name: file; the simulated ones are written here."""
    _run("simulate", "--out", "full.csv", "--effect", "coulomb_friction", "--seconds", "6", "--seed", "1")
    _run("simulate", "--out", "steps.csv", "--motion", "steps", "--rate", "500", "--seconds", "8", "--seed", "2")
    _run("simulate", "--out", "slow.csv", "--rate", "200", "--seconds", "12", "--ageing", "R=+30%@6s", "--seed", "3")
    _without("full.csv", "no_current.csv", ("current_A", "torque_Nm"))
    _without("steps.csv", "no_speed.csv", ("velocity_rad_s",))
    found = {name: Path(f"{name}.csv") for name in ("full", "slow", "no_current", "no_speed")}
    real = {} if data is None else {name: data / f"{name}.csv.gz" for name in REAL}
    return found | {name: path for name, path in real.items() if path.is_file()}


def _answers(captures: dict[str, Path]) -> Iterator[tuple[str, str]]:
    for engine in ("compiled", "filterpy"):
        Path(f"{engine}.toml").write_text(_CONFIG.format(engine=engine))
    for name, path in captures.items():
        for block in BLOCKS:
            yield f"replay {name} --block {block}", _replay(path, "compiled", block)
    for name in ("full", "no_current"):
        for block in (7, 1_000_000):
            yield f"replay {name} --block {block} filterpy", _replay(captures[name], "filterpy", block)
    for name, words in _COMMANDS.items():
        paths = [str(captures.get(word, word)) for word in words]
        if all(Path(p).is_file() for word, p in zip(words, paths, strict=True) if word in (*captures, *REAL)):
            yield name, _document(*paths)


#: Name: the words after `servo-daemon`; a capture's name stands for its file.
_COMMANDS: dict[str, tuple[str, ...]] = {
    "fit full": ("fit", "full", "--effect", "coulomb_friction"),
    "fit full idim": ("fit", "full", "--effect", "coulomb_friction", "--method", "idim"),
    "fit no_current": ("fit", "no_current", "--fix", "R=0.49,K=0.306"),
    "fit no_speed": ("fit", "no_speed"),
    "fit unal validated": ("fit", "unal_prbs", "--validate", "unal_prbs", "--adapt", "0.3"),
    "fit gap": ("fit", "steps.csv", "--effect", "backlash"),
    "compare full": ("compare", "full", "--motors", "100"),
    "compare paper": ("compare", "--paper"),
    "tune full": ("tune", "full"),
    "excite": ("excite", "--config", "compiled.toml", "--out", "motion.csv"),
    "diagnose full": ("diagnose", "full", "--out", "diagnosed-full"),
    "diagnose xl330": ("diagnose", "xl330_up_and_down_kp100", "--out", "diagnosed-xl330"),
}


def _replay(capture: Path, engine: str, block: int) -> str:
    out = Path("estimates.csv")
    _run("replay", str(capture), "--out", str(out), "--config", f"{engine}.toml", "--block", str(block))
    return _hash(out.read_text())


def _document(*words: str) -> str:
    """The hash of the JSON document without times."""
    return _hash(json.dumps(_timeless(json.loads(_run(*words, "--json"))), sort_keys=True))


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _timeless(v) for k, v in value.items() if k not in _TIMES}
    if isinstance(value, list):
        return [_timeless(v) for v in value]
    return _SECONDS.sub("", value) if isinstance(value, str) else value


def _run(*words: str) -> str:
    """`servo-daemon WORDS…` in this process: stdout."""
    result = run_command(*words)
    if result.code != 0:
        raise RuntimeError(f"servo-daemon {' '.join(words)}: exit code {result.code}\n{result.err}")
    return result.out


def _without(source: str, target: str, columns: Sequence[str]) -> None:
    """A capture with fewer channels."""
    with Path(source).open(newline="") as file:
        rows = list(csv.reader(file))
    head = next(k for k, row in enumerate(rows) if row and not row[0].startswith("#"))
    kept = [k for k, name in enumerate(rows[head]) if name not in columns]
    with Path(target).open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerows([row if k < head else [row[i] for i in kept] for k, row in enumerate(rows)])


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]
