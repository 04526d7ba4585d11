"""What is shipped beside the code: example configuration, unit, locks, wheel; and nothing of the machine it grew on."""

from __future__ import annotations

import json
import re
import runpy
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import BaseModel

from drivers.registry import make_driver
from servo_daemon.config import Config, load_config, parse_config

HASHES = re.compile(r"( \\\n    --hash=sha256:[0-9a-f]{64})+\n")


def keys_of(model: type[BaseModel]) -> Iterator[str]:
    """Every key of a configuration model and of the models in it."""
    for name, field in model.model_fields.items():
        yield name
        for part in (field.annotation, *get_args(field.annotation)):
            if isinstance(part, type) and issubclass(part, BaseModel):
                yield from keys_of(part)


def commented_drives(text: str) -> list[dict[str, Any]]:
    """The `[[drive]]` examples in comments, as a user gets them who removes the '# ' in front of each line."""
    blocks = re.findall(r"^# \[\[drive\]\]\n(?:#.*\n)+", text, re.MULTILINE)
    return [tomllib.loads(re.sub(r"^# ?", "", block, flags=re.MULTILINE))["drive"][0] for block in blocks]


@pytest.fixture(scope="module")
def example(repo_root: Path) -> str:
    return (repo_root / "deploy" / "example.toml").read_text(encoding="utf-8")


def tracked_files(root: Path) -> list[Path]:
    listing = subprocess.run(["git", "ls-files", "-z"], cwd=root, check=True, capture_output=True, text=True).stdout
    return [path for name in listing.split("\0") if name and (path := root / name).is_file()]


def test_the_example_is_a_configuration_whose_drive_can_be_made(repo_root: Path) -> None:
    config = load_config(repo_root / "deploy" / "example.toml", {})
    (drive,) = config.drive
    assert make_driver(drive.driver, drive.name, drive.options).info.channels


def test_the_example_mentions_every_key(example: str) -> None:
    wanted = set(keys_of(Config))
    assert {"api", "port", "state_dir", "skew_s", "counts_per_rev", "travel_rad", "speed_ki_V_rad"} <= wanted
    mentioned = set(re.findall(r"^(?:# )?\[*(?:drive\.)?(\w+)(?: =|\]+)", example, re.MULTILINE))
    assert wanted - mentioned == set()


def test_the_examples_in_comments_hold(example: str) -> None:
    drives = commented_drives(example)
    assert [d["driver"] for d in drives] == ["serial", "serial", "can", "can", "replay"]
    config = parse_config({"drive": drives})
    for drive in config.drive:
        if "dbc" not in drive.options:  # needs the user's file
            make_driver(drive.driver, drive.name, drive.options)


#: What requirements.lock holds.
RUNTIME = """
annotated-doc annotated-types anyio argparse-addons bitstruct cantools casadi click cloudpickle cobs colorama
crccheck fastapi filterpy h11 httptools idna joblib latex2mathml markdown-it-py mdurl narwhals numpy
opentelemetry-api packaging prettytable pydantic pydantic-core pygments pyserial python-can rich scikit-learn
scipy setuptools shtab skops sqlalchemy starlette textparser threadpoolctl tqdm typing-extensions
typing-inspection uvicorn uvloop wcwidth wrapt
"""


@pytest.mark.parametrize("name", ["requirements.lock", "requirements-dev.lock"])
def test_every_line_of_a_lock_is_a_version_with_hashes_and_no_address(repo_root: Path, name: str) -> None:
    text = (repo_root / name).read_text(encoding="utf-8")
    entries = re.split(r"^(?=\S)", text, flags=re.MULTILINE)[1:]
    assert len(entries) > 10
    for entry in entries:
        head, hashes = entry.split(" \\\n", 1)
        assert re.fullmatch(r"[a-z0-9.-]+==[0-9][\w.+!]*( ; [^\\]+)?", head), head
        assert HASHES.fullmatch(f" \\\n{hashes}"), head
    assert "://" not in text
    assert not re.search(r"^-", text, re.MULTILINE)


def test_the_locks_hold_what_the_project_asks_for(repo_root: Path) -> None:
    project = tomllib.loads((repo_root / "pyproject.toml").read_text(encoding="utf-8"))
    for lock, asked in {
        "requirements.lock": project["project"]["dependencies"] + project["dependency-groups"]["build"],
        "requirements-dev.lock": project["dependency-groups"]["dev"],
    }.items():
        locked = set(re.findall(r"^([a-z0-9.-]+)==", (repo_root / lock).read_text(encoding="utf-8"), re.MULTILINE))
        names = {re.split(r"[<>=~!; \[]", line, maxsplit=1)[0].lower().replace("_", "-") for line in asked}
        assert names - locked == set(), f"`make lock` brings {lock} up to date"


def test_what_runs_needs_no_more_packages_than_it_uses(repo_root: Path) -> None:
    """A new one is added here knowingly: `make run` installs at most 450 MB."""
    lock = (repo_root / "requirements.lock").read_text(encoding="utf-8")
    assert sorted(set(re.findall(r"^([a-z0-9.-]+)==", lock, re.MULTILINE))) == RUNTIME.split()
    assert f"puts {len(re.findall('^[a-z].*==', lock, re.MULTILINE))} packages" in (repo_root / "README.md").read_text()


def test_slim_leaves_every_library_under_every_name_once(repo_root: Path, tmp_path: Path) -> None:
    package = tmp_path / "casadi"
    headers = package / "include" / "casadi"
    headers.mkdir(parents=True)
    for path in (headers / "core.hpp", package / "libuno.a", package / "libuno.la"):
        path.write_text("for C++", encoding="utf-8")
    libraries = {"libcasadi.so": b"one", "libcasadi.so.3.7": b"one", "libipopt.so.3": b"two"}
    kept = {**libraries, "casadi.py": b"one", "_casadi.so": b"three"}
    for name, content in kept.items():
        (package / name).write_bytes(content)
    slim = runpy.run_path(str(repo_root / "deploy" / "slim.py"))["slim"]
    for _ in range(2):
        slim(package)
        assert {path.name: path.read_bytes() for path in package.iterdir()} == kept
        assert len({path.stat().st_ino for path in package.iterdir()}) == len(kept) - 1


def test_no_file_names_a_registry_or_this_machine(repo_root: Path) -> None:
    # In pieces, so that this file is not a finding itself.
    words = ["pypi" + ".org", "python" + "hosted", "/wo" + "rk/", "/ro" + "ot/", "/opt/" + "pypi", "index" + "-url ="]
    forbidden = re.compile("|".join(re.escape(word) for word in words))
    found = [
        f"{path.relative_to(repo_root)}: {match[0]}"
        for path in tracked_files(repo_root)
        if (match := forbidden.search(path.read_text(encoding="utf-8", errors="ignore")))
    ]
    assert found == []


def test_the_wheel_holds_every_file_of_the_packages(repo_root: Path, tmp_path: Path) -> None:
    source = tmp_path / "source"
    wanted = {"pyproject.toml", "LICENSE", "README.md"}
    packaged = set()
    for path in tracked_files(repo_root):
        name = path.relative_to(repo_root).as_posix()
        if name in wanted or name.split("/")[0] in {"servo_daemon", "drivers"}:
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes(path.read_bytes())
            packaged |= {name} - wanted
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*command, "--wheel-dir", str(tmp_path), str(source)], check=True, capture_output=True)
    (wheel,) = tmp_path.glob("servo_daemon-*.whl")
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert names == packaged
    assert {"servo_daemon/api/dashboard/index.html", "drivers/servo.dbc"} <= names


@pytest.mark.system
def test_systemd_finds_nothing_wrong_with_the_unit(
    repo_root: Path, tmp_path: Path, program: Callable[..., str]
) -> None:
    analyze = program("systemd-analyze")
    text = (repo_root / "deploy" / "servo-daemon.service").read_text(encoding="utf-8")
    unit = tmp_path / "servo-daemon.service"
    # The program is not installed here; what is verified is everything but its path.
    unit.write_text(re.sub(r"^ExecStart=\S+", "ExecStart=/bin/true", text, flags=re.MULTILINE), encoding="utf-8")
    done = subprocess.run(
        [analyze, "verify", "--man=no", "--recursive-errors=no", str(unit)],
        check=False, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


@pytest.mark.system
def test_the_unit_is_as_little_exposed_as_issue_30_asks(repo_root: Path, program: Callable[..., str]) -> None:
    unit = repo_root / "deploy" / "servo-daemon.service"
    command = [program("systemd-analyze"), "security", "--offline=yes", "--threshold=18", "--no-pager", str(unit)]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, [*done.stdout.splitlines()[-1:], done.stderr]


def test_the_image_is_built_from_what_is_here_and_runs_without_rights(repo_root: Path) -> None:
    """No builder of images is at hand in the tests: what can be read of the definition."""
    text = (repo_root / "deploy" / "Containerfile").read_text(encoding="utf-8")
    steps = [line.split(maxsplit=1) for line in re.sub(r"\\\n", " ", text).splitlines() if re.match("[A-Z]", line)]
    bases = [what for step, what in steps if step == "FROM"]
    assert bases == ["debian:bookworm-slim AS build", "debian:bookworm-slim"]
    assert [what for step, what in steps if step == "USER"] == ["servo-daemon"]
    copied = [what.split() for step, what in steps if step == "COPY" and not what.startswith("--from")]
    assert len(copied) > 3
    assert [name for *names, _ in copied for name in names if not (repo_root / name).exists()] == []
    (build,) = [what for step, what in steps if step == "RUN" and "deploy/venv" in what]
    assert build.endswith("deploy/venv /opt/servo-daemon/.venv")
    last = dict(steps)
    assert json.loads(last["ENTRYPOINT"]) == ["servo-daemon"]
    assert json.loads(last["CMD"]) == ["run", "--config", copied[-1][-1]]
    python, flag, code = json.loads(last["HEALTHCHECK"].partition("CMD ")[2])
    assert (python, flag) == ("python", "-c")
    compile(code, "HEALTHCHECK", "exec")
