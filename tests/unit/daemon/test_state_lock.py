"""Two daemons never keep the same drive's state; a lock ends with its process and hinders nobody else."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from servo_daemon.daemon.state_lock import StateLocks
from servo_daemon.errors import ServoDaemonError

#: Holds axis1 in argv[1] until its input ends.
_HOLDER = """
import sys
from pathlib import Path
from servo_daemon.daemon.state_lock import StateLocks
with StateLocks(Path(sys.argv[1])) as locks:
    locks.take(["axis1"])
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
        with StateLocks(tmp_path) as locks, StateLocks(tmp_path) as other:
            locks.take(["axis2"])
            with pytest.raises(ServoDaemonError, match=rf"axis1 in {tmp_path} .*process {holder.pid}\).*--state-dir"):
                locks.take(["axis0", "axis1"])
            other.take(["axis0"])  # what was taken before the refusal is free again
            with pytest.raises(ServoDaemonError, match="axis2"):
                other.take(["axis2"])
            locks.release(["axis2"])
            other.take(["axis2"])
    finally:
        holder.kill()  # no chance to clean up
        holder.communicate()
    with StateLocks(tmp_path) as locks:
        locks.take(["axis1"])
        assert (tmp_path / "axis1.lock").read_text() == f"{os.getpid()}\n"


def test_where_nothing_can_be_locked_nothing_is(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with StateLocks(None) as none, StateLocks(tmp_path / "file") as neither:
        none.take(["axis1"])
        neither.take(["axis1"])
        assert sorted(p.name for p in tmp_path.iterdir()) == ["file"]
