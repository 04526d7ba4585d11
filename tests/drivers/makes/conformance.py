"""What every driver must do, of makes whose drives are behind a pseudo-terminal."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.drivers.conformance import DriverConformance
from tests.drivers.makes.rig import Silent, line


class OnAPort(DriverConformance):
    """Its port is the option `port`."""

    @pytest.fixture
    def silent_options(self, tmp_path: Path) -> Iterator[dict[str, Any] | None]:
        with line(tmp_path / "silent", Silent()):
            yield {"port": str(tmp_path / "silent")}

    @pytest.fixture
    def missing_options(self, tmp_path: Path) -> Iterator[dict[str, Any] | None]:
        yield {"port": str(tmp_path / "nothing")}


class OnABus(DriverConformance):
    """Its adapter speaks SLCAN."""

    @pytest.fixture
    def silent_options(self, tmp_path: Path) -> Iterator[dict[str, Any] | None]:
        with line(tmp_path / "silent", Silent()):
            yield {"interface": "slcan", "channel": str(tmp_path / "silent")}

    @pytest.fixture
    def missing_options(self, tmp_path: Path) -> Iterator[dict[str, Any] | None]:
        yield {"interface": "slcan", "channel": str(tmp_path / "nothing")}
