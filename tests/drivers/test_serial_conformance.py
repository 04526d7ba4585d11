"""The serial driver, both wires, passes the suite of all drivers, over real pseudo-terminals and real pyserial."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.drivers.conformance import DriverConformance
from tests.drivers.serial_rig import serial_rig


class _Serial(DriverConformance):
    kind = "serial"

    @pytest.fixture
    def missing_options(self, tmp_path: Path) -> Iterator[dict[str, Any] | None]:
        yield {"port": str(tmp_path / "nothing")}

    @pytest.fixture
    def silent_port(self) -> Iterator[str]:
        master, slave = os.openpty()
        yield os.ttyname(slave)
        os.close(slave)
        os.close(master)


class TestBinary(_Serial):
    wrong_types = {"port": 5, "baudrate": "fast", "drive_id": 256, "wire": "morse"}  # noqa: RUF012

    @pytest.fixture
    def options(self, tmp_path: Path) -> Iterator[dict[str, Any]]:
        with serial_rig(tmp_path / "drive", realtime=False) as rig:
            yield {"port": str(rig.link)}

    @pytest.fixture
    def silent_options(self, silent_port: str) -> Iterator[dict[str, Any] | None]:
        yield {"port": silent_port}


class TestText(_Serial):
    wrong_types = {  # noqa: RUF012
        "counts_per_rev": "many",
        "counts_modulus": 1,
        "sample_period_s": 0.0,
        "voltage_lsb_V": True,
        "current_lsb_A": float("nan"),
    }

    @pytest.fixture
    def options(self, tmp_path: Path) -> Iterator[dict[str, Any]]:
        with serial_rig(tmp_path / "drive", wire="text") as rig:
            yield {"port": str(rig.link), "wire": "text", "counts_per_rev": 4096}

    @pytest.fixture
    def silent_options(self, silent_port: str) -> Iterator[dict[str, Any] | None]:
        yield {"port": silent_port, "wire": "text", "counts_per_rev": 4096.0}
