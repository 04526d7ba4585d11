"""Two daemons never keep the same drive's state; a lock ends with its process and hinders nobody else."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from servo_daemon.daemon.state_lock import state_locked
from servo_daemon.errors import ServoDaemonError

#: Holds axis1 in argv[1] until its input ends.
_HOLDER = """
import sys
from pathlib import Path
from servo_daemon.daemon.state_lock import state_locked
with state_locked(Path(sys.argv[1]), ["axis1"]):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_drive_of_another_process_is_refused_by_name(tmp_path: Path) -> None:
    holder = subprocess.Popen(
        [sys.executable, "-c", _HOLDER, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with (
            pytest.raises(ServoDaemonError, match=rf"axis1 in {tmp_path} .*process {holder.pid}\).*--state-dir"),
            state_locked(tmp_path, ["axis0", "axis1"]),
        ):
            pass
        with state_locked(tmp_path, ["axis0", "axis2"]):  # what was taken before the refusal is free again
            pass
    finally:
        holder.kill()  # no chance to clean up
        holder.communicate()
    with state_locked(tmp_path, ["axis1"]):
        assert (tmp_path / "axis1.lock").read_text() == f"{os.getpid()}\n"


def test_where_nothing_can_be_locked_nothing_is(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with state_locked(None, ["axis1"]), state_locked(tmp_path / "file", ["axis1"]):
        assert sorted(p.name for p in tmp_path.iterdir()) == ["file"]
