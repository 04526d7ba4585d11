"""A PostgreSQL server of a test's own: on a socket in its folder, no port, gone afterwards."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

#: Debian keeps the server's programs beside the PATH, one folder a version.
_DEBIAN = Path("/usr/lib/postgresql")


def find(program: str) -> str | None:
    """The newest of that name; None: it is not installed."""
    folders = sorted(_DEBIAN.glob("*/bin"), key=lambda p: float(p.parent.name), reverse=True)
    return next((str(f / program) for f in folders if (f / program).exists()), shutil.which(program))


@contextmanager
def server(folder: Path) -> Iterator[str]:
    """The URL of an empty database. As root the server runs as the user `postgres`, because it refuses to be root."""
    initdb, postgres = find("initdb"), find("postgres")
    assert initdb is not None and postgres is not None
    user = "postgres" if os.geteuid() == 0 else pwd.getpwuid(os.geteuid()).pw_name
    if os.geteuid() == 0:
        shutil.chown(folder, user)
    data = folder / "data"
    options = {"cwd": folder, "user": user if os.geteuid() == 0 else None}
    made = [initdb, "-D", str(data), "-U", user, "--auth=trust", "--no-sync", "--encoding=UTF8", "--locale=C"]
    subprocess.run(made, check=True, capture_output=True, **options)  # type: ignore[call-overload]
    run = [postgres, "-D", str(data), "-k", str(folder), "-c", "listen_addresses=", "-c", "fsync=off"]
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(run, stdout=log, stderr=log, **options)  # type: ignore[call-overload]
    try:
        yield f"postgresql://{user}@/postgres?host={folder}"
    finally:
        process.send_signal(2)  # SIGINT: fast shutdown
        process.wait(20)
