"""Driver "cia402": frames as CiA 301 and 402 have them, and a simulated node behind an SLCAN adapter."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.cia402.drive import Cia402Driver, may_send
from drivers.cia402.objects import VOLTAGES, eds_pdos
from drivers.cia402.sdo import Uploads, answer, upload
from drivers.polling.can_link import Frame, pack, unpack
from drivers.registry import make_driver
from servo_daemon.errors import DriverConfigError
from servo_daemon.samples import Quality, concatenate
from servo_daemon.sim_drive.makes.can_nodes import SlcanBus
from servo_daemon.sim_drive.makes.cia402 import Cia402Node
from tests.drivers.conformance import DriverConformance, read_until
from tests.drivers.makes.can_rig import batch
from tests.drivers.makes.rig import FREQUENCY_RAD_S, current_of, line, sine_motor

PDO = {"0x185": ["statusword", "position", "torque"]}
BUS = {"interface": "virtual", "channel": "cia402-unused", "node_id": 5, "counts_per_rev": 8192}
RATED = {"rated_torque_Nm": 2.0}

EDS = """
[1800sub1]
ParameterName=COB-ID
DefaultValue=$NODEID+0x180
[1A00sub0]
DefaultValue=3
[1A00sub1]
DefaultValue=0x60410010
[1A00sub2]
DefaultValue=0x60640020
[1A00sub3]
DefaultValue=0x60770010
[1801sub1]
DefaultValue=$NODEID+0x80000280
[1A01sub0]
DefaultValue=1
[1A01sub1]
DefaultValue=0x60410010
"""


def _driver(**options: Any) -> Cia402Driver:
    driver = make_driver("cia402", "axis1", BUS | options)
    assert isinstance(driver, Cia402Driver)
    return driver


def _listening(**options: Any) -> Any:
    return _driver(**RATED, **options)._inner._paced._decoder  # type: ignore[union-attr]


def _pdo(counts: int, torque: int) -> bytes:
    return struct.pack("<HIh", 0x0637, counts & 0xFFFF_FFFF, torque)


@pytest.mark.parametrize("source", ["pdo", "eds"])
def test_a_pdo_is_read_as_it_is_mapped(source: str, tmp_path: Path) -> None:
    (tmp_path / "drive.eds").write_text(EDS)
    decoder = _listening(**({"pdo": PDO} if source == "pdo" else {"eds": str(tmp_path / "drive.eds")}))
    (block,) = decoder.feed(batch([(0x185, _pdo(4096, -250)), (0x186, b""), (0x185, _pdo(-2048, 1000))]))
    np.testing.assert_allclose(block.position_rad, [math.pi, -math.pi / 2])
    np.testing.assert_allclose(block.torque_Nm, [-0.5, 2.0])


def test_the_position_goes_on_over_the_end_of_its_counter() -> None:
    decoder = _listening(pdo=PDO)
    counts = [2**31 - 4096, -(2**31), -(2**31) + 4096]
    (block,) = decoder.feed(batch([(0x185, _pdo(c, 0)) for c in counts]))
    np.testing.assert_allclose(np.diff(block.position_rad), math.pi)


def test_two_pdos_make_a_sample_with_the_last_one() -> None:
    pdo = {"0x185": ["position"], "0x285": ["current", "velocity"]}
    decoder = _listening(pdo=pdo, rated_current_A=4.0, velocity_unit=1e-3)
    frames = [(0x185, struct.pack("<i", 2048)), (0x285, struct.pack("<hi", 500, -1500))]
    (block,) = decoder.feed(batch(frames))
    assert len(block) == 1
    np.testing.assert_allclose((block.position_rad[0], block.current_A[0]), (math.pi / 2, 2.0))
    np.testing.assert_allclose(block.velocity_rad_s, [-1.5])


def test_an_upload_is_that_of_cia_301() -> None:
    (position,) = (o for o in _driver(**RATED)._inner.objects if o.index == 0x6064)  # type: ignore[union-attr]
    assert upload(5, position) == Frame(0x605, bytes.fromhex("4064600000000000"))
    assert answer(bytes.fromhex("4364600010270000")) == ((0x6064, 0), bytes.fromhex("10270000"), 0)
    assert answer(bytes.fromhex("4b776000f4010000")) == ((0x6077, 0), bytes.fromhex("f401"), 0)
    assert answer(bytes.fromhex("8077600000000206")) == ((0x6077, 0), None, 0x0602_0000)
    assert answer(bytes.fromhex("6064600000000000")) is None  # of a download


def test_a_refused_object_is_named() -> None:
    driver = _driver(**RATED)
    uploads = driver._inner._uploads  # type: ignore[union-attr]
    assert [math.isnan(r.value) for r in uploads.feed(pack(Frame(0x585, bytes.fromhex("8077600000000206"))))] == [True]
    assert driver.remark is not None and "0x6077:00" in driver.remark and "0x06020000" in driver.remark


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({}, "rated_torque_Nm"),
        ({"pdo": {"0x185": ["position", "torgue"]}}, "torgue"),
        ({"pdo": {"x": ["position"]}}, "pdo"),
        ({"pdo": {"0x185": ["position", "dc_link", "current"]}, "rated_current_A": 1.0}, "8 bytes"),
        ({"pdo": {"0x185": ["statusword"]}}, "position"),
        ({"eds": "nowhere.eds"}, "nowhere.eds"),
        ({"voltage": "siemens"}, "beckhoff_ax8000"),
        ({"counts_per_rev": 0, **RATED}, "counts_per_rev"),
    ],
)
def test_impossible_options_are_named(options: dict[str, Any], text: str) -> None:
    with pytest.raises(DriverConfigError, match=text):
        _driver(**options)


@pytest.mark.parametrize("text", ["", "[1800sub1", "[1800sub1]\nDefaultValue=abc\n[1A00sub0]\nDefaultValue=1\n"])
def test_what_is_no_eds_is_told(text: str) -> None:
    with pytest.raises(DriverConfigError, match=r"x\.eds"):
        eds_pdos(text, 5, None, "x.eds")


@pytest.mark.parametrize("seed", range(10))
def test_any_frames_come_to_nothing_worse_than_a_counter(seed: int) -> None:
    random = np.random.default_rng(seed)
    decoder, uploads = _listening(pdo=PDO), Uploads(5, [VOLTAGES["beckhoff_ax8000"]])
    for _ in range(50):
        payloads = [random.integers(0, 256, random.integers(0, 9), dtype=np.uint8).tobytes() for _ in range(10)]
        for block in decoder.feed(batch([(0x185, p) for p in payloads])):
            assert np.isfinite(block.position_rad).all()
        uploads.feed(b"".join(pack(Frame(0x585, p)) for p in payloads))


def _node(**options: Any) -> SlcanBus:
    step_s = options.get("period_s") or 5e-3
    return SlcanBus(Cia402Node(sine_motor(step_s), torque_per_ampere=0.5, node_id=5, **options))


def _only_allowed(bus: SlcanBus, driver: Any) -> None:
    allowed = may_send(5, getattr(driver._inner, "objects", []))
    assert {Frame(f.frame_id, f.data) for f in bus.heard} <= allowed


class _Cia402(DriverConformance):
    kind = "cia402"
    wrong_types = {"node_id": 128, "pdo": [], "counts_per_rev": "x", "rate_hz": -1, "sync_s": 0, "voltage": 3}  # noqa: RUF012
    more: dict[str, Any]
    period_s: float | None = 5e-3

    @pytest.fixture
    def options(self, tmp_path: Path) -> Iterator[dict[str, Any]]:
        bus, options = _node(period_s=self.period_s), BUS | RATED | self.more
        with line(tmp_path / "can", bus):
            yield options | {"interface": "slcan", "channel": str(tmp_path / "can"), "bitrate": 1_000_000}
        _only_allowed(bus, _driver(**RATED, **self.more))
        assert bool(bus.heard) <= (self.period_s is None or "pdo" not in self.more)

    @pytest.fixture
    def silent_options(self, tmp_path: Path) -> Iterator[dict[str, Any] | None]:
        yield BUS | RATED | self.more

    @pytest.fixture
    def missing_options(self, tmp_path: Path) -> Iterator[dict[str, Any] | None]:
        yield BUS | RATED | self.more | {"interface": "slcan", "channel": str(tmp_path / "nothing")}


class TestListeningConformance(_Cia402):
    more = {"pdo": PDO, "period_s": 5e-3}  # noqa: RUF012


class TestSyncConformance(_Cia402):
    more = {"pdo": PDO, "sync_s": 5e-3}  # noqa: RUF012
    period_s = None


class TestSdoConformance(_Cia402):
    more = {"rate_hz": 100.0}  # noqa: RUF012


@pytest.mark.parametrize("more", [{"pdo": PDO, "period_s": 2e-3}, {"rate_hz": 50.0, "voltage": "beckhoff_ax8000"}])
def test_values_of_a_live_node(more: dict[str, Any], tmp_path: Path) -> None:
    bus = _node()
    options = BUS | RATED | more | {"interface": "slcan", "channel": str(tmp_path / "can"), "bitrate": 1_000_000}
    with line(tmp_path / "can", bus), make_driver("cia402", "axis1", options) as driver:
        block = concatenate(read_until(driver, 150))
    position = block.position_rad
    assert position is not None and block.torque_Nm is not None
    np.testing.assert_allclose(block.torque_Nm, 0.5 * current_of(position), atol=5e-3)
    good = block.quality & ~np.uint8(Quality.GAP_BEFORE) == 0
    assert good.all() and np.ptp(position) > 0.5
    if block.voltage_V is not None:
        speed = 2.0 * FREQUENCY_RAD_S * np.sqrt(np.maximum(0.0, 1.0 - (position / 2.0) ** 2))
        np.testing.assert_allclose(np.abs(block.voltage_V), 0.75 * speed, atol=0.1)
    _only_allowed(bus, driver)


def test_frames_of_the_link() -> None:
    assert list(unpack(pack(Frame(0x605, b"12345678")))) == [Frame(0x605, b"12345678")]
