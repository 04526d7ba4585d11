"""A Debian with a real systemd as process 1, in a container, with servo-daemon's package built and installed in it.

Two layers. The system is kept in the user's cache between runs (debootstrap once, then `make deb` from this source
tree, which takes seconds when the lock is the same). What is booted is an overlay over it in memory, with nothing but
a loopback network: no run sees anything of another. Only /opt is the cache's own, for it is large: each run installs it
anew. Needs root; registers nothing with the host's systemd.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")

SUITE = "bookworm"
#: Debian 12 has Python 3.11, the oldest that we support. The compiler: compiled plants are loaded inside the sandbox.
#: debhelper builds the package.
PACKAGES = "systemd,systemd-sysv,dbus,udev,make,python3,python3-venv,gcc,libc6-dev,debhelper"
UNIT = "servo-daemon"
SOURCE = "/usr/src/servo-daemon"
#: In the container: what `make deb` has made, the same with a lower version, and the same without the packages of the
#: lock, which are not ours to be found fault with.
NEW, OLD, OWN = (f"{SOURCE}/build/{name}.deb" for name in ("new", "old", "own"))
OLD_VERSION = "0.0.1"
#: Nobody starts a service here, nothing runs: as whoever makes an image for many machines installs it.
_PACKAGES_SCRIPT = f"""
cd {SOURCE}
rm -f build/*.deb
make deb
mv build/{UNIT}_*.deb {NEW}
tree=build/deb/tree/debian/{UNIT}
pack() {{ dpkg-deb --root-owner-group -Z$1 --build $tree $2; }}
version() {{ sed -i "s/^Version: .*/Version: $1/" $tree/DEBIAN/control; }}
version {OLD_VERSION}
pack none {OLD}
version "$(dpkg-deb --field {NEW} Version)"
rm -rf $tree/opt/{UNIT}/.venv/lib
sed -i '/\\.venv\\/lib/d' $tree/DEBIAN/md5sums
pack gzip {OWN}
dpkg --purge {UNIT}
dpkg --install --force-unsafe-io {OLD}
"""
#: Prints what an address answers, a refusal too.
_GET = """
import sys, urllib.error, urllib.request
request = urllib.request.Request(sys.argv[1], headers={"Authorization": f"Bearer {sys.argv[2]}"} if sys.argv[2] else {})
try:
    answer = urllib.request.urlopen(request, timeout=5)
except urllib.error.HTTPError as error:
    answer = error
sys.stdout.write(answer.read().decode())
"""
_NSPAWN = ("systemd-nspawn", "--quiet", "--register=no", "--keep-unit", "--private-network", "--console=pipe")


class Machine:
    """A booted container. Commands run in it as root, through the namespaces of its process 1.

    Attributes:
        at_boot: what the boot has made of the service, for whoever looks first to write down.
    """

    def __init__(self, leader: int) -> None:
        self.at_boot: dict[str, str] = {}
        self._enter = ["nsenter", "--target", str(leader), "--mount", "--uts", "--ipc", "--net", "--pid", "--root"]

    def run(self, *command: str, stdin: str = "", check: bool = True) -> str:
        """What the command prints on stdout."""
        done = subprocess.run(
            [*self._enter, *command], input=stdin, capture_output=True, text=True, timeout=120, check=False
        )
        assert done.returncode == 0 or not check, f"{command}: {done.returncode}\n{done.stdout}{done.stderr}"
        return done.stdout

    def show(self, *names: str) -> dict[str, str]:
        """Properties of the unit, as systemd has them now."""
        text = self.run("systemctl", "show", UNIT, f"--property={','.join(names)}")
        return dict(line.split("=", 1) for line in text.splitlines())

    def is_(self, **wanted: str) -> bool:
        """The unit's properties have these values now."""
        return self.show(*wanted) == wanted

    def journal(self) -> str:
        """What the unit, and systemd about it, have logged since the boot or the last `forget_journal`."""
        return self.run("journalctl", "--unit", UNIT, "--no-pager", "--output=cat")

    def forget_journal(self) -> None:
        self.run("journalctl", "--rotate", "--vacuum-time=1us")

    def get(self, path: str, token: str = "") -> Any:
        """A JSON document of the daemon's API."""
        return json.loads(self.run("python3", "-c", _GET, f"http://127.0.0.1:8077{path}", token))

    def write(self, path: str, text: str) -> None:
        self.run("tee", path, stdin=text)


def wait_for(what: str, condition: Callable[[], T], timeout_s: float = 60.0) -> T:
    """The condition's first true value; asked again until then."""
    deadline = time.monotonic() + timeout_s
    while not (value := condition()):
        assert time.monotonic() < deadline, f"not within {timeout_s:g} s: {what}"
        time.sleep(0.1)  # between two questions
    return value


@contextlib.contextmanager
def packaged_root(repo_root: Path) -> Iterator[Path]:
    """The root file system with the older package installed and the newer one beside it; locked while it is in use."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "servo-daemon-tests"
    cache.mkdir(parents=True, exist_ok=True)
    root = cache / f"{SUITE}-{hashlib.sha256(PACKAGES.encode()).hexdigest()[:12]}"
    with (cache / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not root.is_dir():
            _bootstrap(root)
        _copy_source(root / SOURCE.lstrip("/"), repo_root)
        _call(
            *_NSPAWN, f"--directory={root}", f"--bind-ro={_wheels(repo_root, cache)}:/wheels",
            "--setenv=PIP_NO_INDEX=1", "--setenv=PIP_FIND_LINKS=/wheels", "sh", "-euxc", _PACKAGES_SCRIPT,
        )  # fmt: skip
        yield root


def _bootstrap(root: Path) -> None:
    unfinished = root.with_suffix(".unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    _call("debootstrap", "--variant=minbase", f"--include={PACKAGES}", SUITE, str(unfinished))
    unfinished.rename(root)


def _wheels(repo_root: Path, cache: Path) -> Path:
    """A folder with every file of requirements.lock for the container's Python, so that it needs no network."""
    lock = repo_root / "requirements.lock"
    wheels = cache / f"wheels-{hashlib.sha256(lock.read_bytes()).hexdigest()[:12]}"
    if not wheels.is_dir():
        for old in cache.glob("wheels-*"):
            shutil.rmtree(old)
        unfinished = wheels.with_suffix(".unfinished")
        _call(
            sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--no-build-isolation", "--require-hashes",
            "--python-version=3.11", f"--requirement={lock}", f"--dest={unfinished}",
        )  # fmt: skip
        unfinished.rename(wheels)
    return wheels


def _copy_source(source: Path, repo_root: Path) -> None:
    """The source tree as it is in git, with what has changed since; what an earlier run has built there stays."""
    source.mkdir(parents=True, exist_ok=True)
    for old in source.iterdir():
        if old.is_dir() and old.name != "build":
            shutil.rmtree(old)
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(command, cwd=repo_root, check=True, capture_output=True, text=True).stdout
    for name in filter(None, names.split("\0")):
        if (repo_root / name).exists():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(repo_root / name, source / name, follow_symlinks=False)


def _call(*command: str) -> None:
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{' '.join(command)}: {done.returncode}\n{done.stdout[-4000:]}{done.stderr[-4000:]}"


@contextlib.contextmanager
def booted(root: Path) -> Iterator[Machine]:
    """Boot an overlay of `root` and wait until systemd says that the system runs."""
    command = [*_NSPAWN, "--boot", "--volatile=overlay", f"--directory={root}", f"--bind={root}/opt:/opt"]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL) as container:
        try:
            leader = wait_for("process 1 of the container", lambda: _leader(container))
            machine = Machine(leader)
            state = wait_for("a booted system", lambda: _state(machine), timeout_s=180.0)
            assert state == "running", machine.run("systemctl", "--failed", check=False)
            yield machine
        finally:
            container.terminate()  # systemd-nspawn shuts its system down
            try:
                container.wait(30)
            except subprocess.TimeoutExpired:
                container.kill()


def _leader(container: subprocess.Popen[bytes]) -> int:
    """The container's process 1 as the host numbers it; 0 as long as there is none.

    systemd-nspawn's first child only mounts the file systems and then ends, in milliseconds or, on a busy disk, longer:
    process 1 is the child that has a PID namespace of its own.
    """
    assert container.poll() is None, f"systemd-nspawn ended: {container.returncode}"
    children = Path(f"/proc/{container.pid}/task/{container.pid}/children").read_text(encoding="ascii").split()
    return next((int(child) for child in children if _is_process_1(child)), 0)


def _is_process_1(pid: str) -> bool:
    """Its number in the innermost PID namespace is 1 (`NSpid` of proc(5)); it may end while it is asked."""
    try:
        status = Path(f"/proc/{pid}/status").read_text(encoding="ascii", errors="replace")
    except (FileNotFoundError, ProcessLookupError):
        return False
    numbers = next(line.split()[1:] for line in status.splitlines() if line.startswith("NSpid:"))
    return len(numbers) > 1 and numbers[-1] == "1"


def _state(machine: Machine) -> str:
    """The system's state once it is final, before that an empty text."""
    state = machine.run("systemctl", "is-system-running", check=False).strip()
    return state if state in {"running", "degraded"} else ""
