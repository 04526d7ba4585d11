"""What a user is told of a cluster."""

from __future__ import annotations

import signal

import pytest

from servo_daemon.errors import BadInputError
from servo_daemon.fleet.cluster import _interrupts_ignored, cluster


def test_a_scheduler_without_workers_is_told(caplog: pytest.LogCaptureFixture) -> None:
    distributed = pytest.importorskip("distributed", reason="the extra dask is not installed")
    with (
        distributed.LocalCluster(n_workers=0, host="127.0.0.1", dashboard_address="127.0.0.1:0") as local,
        cluster(local.scheduler_address),
    ):
        assert "no worker yet" in caplog.text


def test_what_is_no_address_is_named() -> None:
    pytest.importorskip("distributed", reason="the extra dask is not installed")
    with pytest.raises(BadInputError, match=r"--dask nonsense: no scheduler answers"), cluster("nonsense"):
        pass


def test_workers_leave_an_interrupt_to_the_command() -> None:
    before = signal.getsignal(signal.SIGINT)
    with _interrupts_ignored():
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    assert signal.getsignal(signal.SIGINT) is before
