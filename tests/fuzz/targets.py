"""What is fed, with which inputs. A target makes a step; a step feeds one input and raises for a fault: any exception
but the project's own, a message of several lines, a sample that is not finite or goes back in time."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from random import Random
from typing import Any

import numpy as np
from can.interfaces.slcan import slcanBus

from drivers.base import DriverCounters
from drivers.can.decode import load_dbc
from drivers.can.formula import parse_formula
from drivers.can.map import parse_signal_map
from drivers.can.ours.own import OwnDecoder
from drivers.can.receive import Receiver
from drivers.can.slcan import ReadAhead
from drivers.serial.decoder import BinaryDecoder
from drivers.serial.frame import encode_frame
from drivers.serial.text import TextDecoder
from drivers.vesc.dialogue import VescDialogue
from drivers.vesc.packets import encode_packet
from servo_daemon.captures import read_capture
from servo_daemon.config import load_config
from servo_daemon.daemon.persist import StateFile
from servo_daemon.errors import ServoDaemonError
from servo_daemon.learning.model import manifest as manifest_module
from servo_daemon.learning.model import model_file
from servo_daemon.samples import SampleBlock
from tests.can_tools import RampSource, batch, frames_of
from tests.drivers.makes import test_fuzz as makes
from tests.fuzz.spoiling import spoilt_bytes, spoilt_text
from tests.learned_models import small_model
from tests.property.test_can_decoders import DBC, OWN_IDS, vendor
from tests.wire_tools import describe, frame

ROOT = Path(__file__).resolve().parents[2]
Step = Callable[[], None]
Reader = Callable[[Path], object]
#: A line that does not end is given up after 256 bytes; no decoder may keep more of anything that is no frame.
_KEPT = 100_000


@contextmanager
def refused() -> Iterator[None]:
    """The project's own errors, of one line, are right answers."""
    try:
        yield
    except ServoDaemonError as error:
        assert len(str(error).splitlines()) == 1, f"several lines: {error}"


def sound(block: SampleBlock | None) -> None:
    if block is not None:
        assert len(block) > 0 and np.isfinite(block.time_s).all() and (np.diff(block.time_s) > 0).all()
        for name in block.channels:
            assert not np.isinf(getattr(block, name)).any(), name


def serial(random: Random, _: Path) -> Step:
    decoder, count = BinaryDecoder(), 0

    def step() -> None:
        nonlocal count
        count += 1
        data = (
            describe() if random.randrange(20) == 0 else frame(10 * (count - random.choice((0, 0, 0, 1, 500)) % count))
        )
        if random.randrange(3) == 0:  # a good checksum, any content
            data = encode_frame(spoilt_bytes(random, b"\x02\x07\x01\x01" + data[4:60])[:200] or b"\0")
        elif random.randrange(4):
            data = spoilt_bytes(random, data)
        sound(decoder.feed(data))
        while decoder.has_ready:
            sound(decoder.feed(b""))

    return step


def text(random: Random, _: Path) -> Step:
    decoder = TextDecoder(4096.0, sample_period_s=None)
    count = 0

    def step() -> None:
        nonlocal count
        count += 1
        line = f"{1000 * count},{random.randrange(-999, 999)},12,{count}\n"
        data = line.encode() if random.randrange(4) == 0 else spoilt_text(random, line).encode("utf-8", "replace")
        sound(decoder.feed(data))
        while decoder.has_ready:
            sound(decoder.feed(b""))

    return step


def own_can(random: Random, _: Path) -> Step:
    decoder, host_s = OwnDecoder(1, DriverCounters()), 0.0
    good = [(f.frame_id, f.data) for f in frames_of(RampSource(), 600)]

    def step() -> None:
        nonlocal host_s
        host_s += random.choice((0.001, 0.01, 0.1, 3.0))
        some = [random.choice(good) for _ in range(random.randrange(1, 6))]
        some += [(random.choice((*OWN_IDS, 0x7FF)), random.randbytes(random.choice((0, 4, 8, 8, 8)))) for _ in range(3)]
        for block in decoder.feed(batch(some, host_s)):
            sound(block)

    return step


def vendor_can(random: Random, _: Path) -> Step:
    decoders, host_s = [vendor(False), vendor(True)], 0.0

    def step() -> None:
        nonlocal host_s
        host_s += random.choice((0.001, 0.01, 1.0))
        some = [(random.randrange(1, 5), random.randbytes(random.choice((0, 7, 8, 8, 8)))) for _ in range(4)]
        for block in random.choice(decoders).feed(batch(some, host_s, [host_s] * 4)):
            sound(block)

    return step


class _Port:
    """A serial port with bytes that have arrived."""

    timeout = 0

    def __init__(self) -> None:
        self.waiting = b""

    @property
    def in_waiting(self) -> int:
        return len(self.waiting)

    def read(self, n: int = 1) -> bytes:
        out, self.waiting = self.waiting[:n], self.waiting[n:]
        return out


def slcan(random: Random, _: Path) -> Step:
    port = _Port()
    bus: Any = slcanBus.__new__(slcanBus)  # without opening a port
    bus._buffer, bus._queue, bus.serialPortOrig, bus._is_shutdown = bytearray(), SimpleQueue(), ReadAhead(port), True
    bus.set_filters(None)
    receiver = Receiver(bus)
    good = [b"t10181122334455667788\r", b"T1FFFFFFF2AABB\r", b"d1018112233\r", b"r1010\r", b"z\rV1013\r", b"\a"]

    def step() -> None:
        port.waiting += spoilt_bytes(random, random.choice(good))
        while bus.serialPortOrig.in_waiting:
            receiver._next(0.0)
        assert len(bus._buffer) < _KEPT

    return step


def of_makes(random: Random, _: Path) -> Step:
    cases = (makes._moteus, makes._dynamixel, makes._feetech, makes._mit, makes._cia402, makes._sdo, makes._simplefoc)
    steps = [case() for case in cases]
    dialogue, count = VescDialogue(None, DriverCounters(), 50), 0

    def step() -> None:
        nonlocal count
        count += 1
        if count % 8 == 0:
            packet = encode_packet(bytes([random.choice((0, 4, 50))]) + random.randbytes(random.randrange(1, 60)))
            dialogue.feed(packet if random.randrange(2) else spoilt_bytes(random, packet))
            return
        good, feed = steps[count % 7]
        feed(spoilt_bytes(random, good), count)

    return step


def formula(random: Random, _: Path) -> Step:
    good = ("(X - 2.5) * 10 / max(Y, 1e-3)", "abs(sin(X)) + sqrt(Y)", "-X * -Y + min(X, 3)", "sign(cos(X)) / 0")
    values = np.array([0.0, -1.0, 1e300, np.nan])

    def step() -> None:
        with refused():
            found = parse_formula(spoilt_text(random, random.choice(good)), "x")
            found(dict.fromkeys(found.names, values))

    return step


def dbc(random: Random, folder: Path) -> Step:
    path, good = folder / "a.dbc", (DBC, (ROOT / "deploy" / "servo.dbc").read_text())
    signals = {"current_A": "A.Real", "position_counts": "C.Position", "time_s": "C.Time"}

    def step() -> None:
        path.write_text(spoilt_text(random, random.choice(good)), encoding="utf-8", errors="replace")
        with refused():
            parse_signal_map(signals, load_dbc(path), "x")

    return step


def configuration(random: Random, folder: Path) -> Step:
    path, good = folder / "a.toml", (ROOT / "deploy" / "example.toml").read_text()
    lines = [line.lstrip("# ") if "=" in line or "[" in line else line for line in good.splitlines()]
    short = '[[drive]]\nname = "a"\ndriver = "serial"\n[drive.nominal]\nR = 1.0\n[drive.options]\nport = "/dev/x"\n'

    def step() -> None:
        some = random.sample(lines, random.randrange(1, 6))
        path.write_text(spoilt_text(random, short + "\n".join(some)), encoding="utf-8", errors="replace")
        with refused():
            load_config(path, {})

    return step


def state(random: Random, folder: Path) -> Step:
    good = {
        "schema": 1, "identity": "x", "model": [], "names": ["R", "L"], "mean": [0.0, -6.0],
        "covariance": [[0.01, 0.001], [0.001, 0.02]],
        "adopted": {"configured": [], "nominal": {"Tc": 0.1}},
    }  # fmt: skip
    file, path = StateFile(folder, "axis"), folder / "axis.state.json"
    whole = json.dumps(good)

    def step() -> None:
        path.write_text(spoilt_text(random, whole), encoding="utf-8", errors="replace")
        saved = file.load("x", ())
        assert saved is None or np.isfinite(saved.mean).all()

    return step


def capture(random: Random, folder: Path) -> Step:
    rows = [f"{k / 1000},{k % 7},{k % 5 / 3},{k * 0.01}" for k in range(40)]
    good = "# drive: x\n# voltage: held\ntime_s,voltage_V,current_A,position_rad\n" + "\n".join(rows) + "\n"
    path = folder / "a.csv"

    def step() -> None:
        path.write_text(spoilt_text(random, good), encoding="utf-8", errors="replace", newline="")
        with refused():
            found = read_capture(path)
            assert np.isfinite(found.time_s).all() and (np.diff(found.time_s) > 0).all()

    return step


def model(random: Random, folder: Path) -> Step:
    """Files whose hashes are right, made by somebody who wants them loaded."""
    path = folder / "m.model"
    model_file.save_model(small_model(150), path)
    manifest, numbers = manifest_module.unpacked(path, own=False)
    manifest.pop("manifest_sha256", None)
    whole = json.dumps(manifest)

    def step() -> None:
        try:
            content = json.loads(spoilt_text(random, whole)) if random.randrange(2) else dict(manifest)
        except (ValueError, RecursionError):
            content = dict(manifest)
        new = spoilt_bytes(random, numbers) if random.randrange(2) else numbers
        if isinstance(content, dict):
            content["model_sha256"] = hashlib.sha256(new).hexdigest()
            content["manifest_sha256"] = manifest_module.content_hash(content)
        path.write_bytes(model_file._packed(content, new))
        with refused():
            model_file.load_model(path)

    return step


@dataclass(frozen=True)
class Target:
    """Attributes:
    share: of all inputs; the dearer an input is, the fewer there are.
    """

    make: Callable[[Random, Path], Step]
    share: float


TARGETS: Mapping[str, Target] = {
    "serial wire": Target(serial, 0.20),
    "text wire": Target(text, 0.18),
    "CAN, ours": Target(own_can, 0.07),
    "CAN by DBC": Target(vendor_can, 0.07),
    "slcan": Target(slcan, 0.12),
    "other makes": Target(of_makes, 0.12),
    "formulas": Target(formula, 0.118),
    "state files": Target(state, 0.04),
    "configurations": Target(configuration, 0.04),
    "captures": Target(capture, 0.03),
    "DBC files": Target(dbc, 0.01),
    "model files": Target(model, 0.002),
}
