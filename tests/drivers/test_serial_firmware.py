"""The C encoder for firmware, compiled here: against the golden vectors, the `cobs` package and our decoder."""

from __future__ import annotations

import random
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from cobs import cobs
from crccheck.crc import Crc16Ibm3740

from drivers.serial.command import Command, encode_command
from drivers.serial.decoder import BinaryDecoder
from drivers.serial.frame import encode_frame
from drivers.serial.text import TextDecoder
from servo_daemon.samples import Quality
from servo_daemon.sim_drive.commanded import CommandedOutput
from tests.wire_tools import DESCRIPTIONS, SAMPLES, SERVO, VECTORS, rows_of

pytestmark = pytest.mark.system

FIRMWARE = Path(__file__).parents[2] / "deploy" / "firmware"
COMPILER = shutil.which("gcc") or shutil.which("cc")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror", "-O1", f"-I{FIRMWARE}")


def compile_c(source: Path, program: Path, *flags: str) -> Path:
    if COMPILER is None:
        pytest.skip("no C compiler (gcc or cc) on this machine")
    run = subprocess.run(
        [COMPILER, *STRICT, *flags, "-o", program, source], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    return program


@pytest.fixture(scope="module")
def harness(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("firmware")
    return compile_c(Path(__file__).with_name("wire_harness.c"), folder / "harness", "-DSERVO_WIRE_MAX_PAYLOAD=1024")


def ask(harness: Path, *commands: str) -> list[str]:
    run = subprocess.run([harness], input="\n".join(commands) + "\n", capture_output=True, text=True, check=True)
    return run.stdout.split("\n")[:-1]


def setup_commands(name: str, sequence: int = 0) -> list[str]:
    vector = DESCRIPTIONS[name]
    channels = " ".join(" ".join(str(x) for x in c) for c in vector["channels"])
    fields = [vector[k] for k in ("drive_id", "session", "sample_period_ns", "position_modulus")]
    return [
        f"init {len(vector['channels'])} {channels}",
        f"set {' '.join(map(str, fields))} {sequence} {vector['identity'].encode().hex()}",
    ]


@pytest.mark.parametrize("name", DESCRIPTIONS)
def test_description_is_golden(harness: Path, name: str) -> None:
    assert ask(harness, *setup_commands(name), "description") == [
        "0",
        bytes.fromhex(VECTORS[name]["frame"]).hex(),
    ]


@pytest.mark.parametrize("name", SAMPLES)
def test_samples_are_golden(harness: Path, name: str) -> None:
    vector = SAMPLES[name]
    times, rows = rows_of(vector)
    adds = [f"add {t % 2**32} {' '.join(map(str, row))}" for t, row in zip(times, rows, strict=True)]
    answers = ask(harness, *setup_commands(vector["description"], vector["sequence"]), *adds, "samples")
    assert answers[1:-1] == [str(k + 1) for k in range(len(rows))]
    assert answers[-1] == bytes.fromhex(vector["frame"]).hex()


def test_framing_agrees_with_the_cobs_package(harness: Path) -> None:
    noise = random.Random(2)
    lengths = [*range(1, 6), *range(250, 260), *range(504, 512), 762, 1022, 1023, 1024]
    payloads = [bytes(noise.choice((0, 1, 255)) for _ in range(n)) for n in lengths]
    payloads += [bytes(noise.randrange(1, 256) for _ in range(n)) for n in lengths]
    payloads += [bytes(n) for n in lengths]
    expected = [(cobs.encode(p + Crc16Ibm3740.calc(p).to_bytes(2, "big")) + b"\0").hex() for p in payloads]
    assert ask(harness, *(f"frame {p.hex()}" for p in payloads)) == expected


def test_full_blocks_end_exactly_at_the_frame(harness: Path) -> None:
    """A frame whose 254 bytes hold no zero, CRC included, is where COBS encoders differ or go wrong."""
    payload = next(
        p for k in range(1, 256) if 0 not in Crc16Ibm3740.calc(p := bytes([k]) + b"\x11" * 251).to_bytes(2, "big")
    )
    (answer,) = ask(harness, f"frame {payload.hex()}")
    assert len(bytes.fromhex(answer)) == 256
    assert cobs.decode(bytes.fromhex(answer)[:-1])[:-2] == payload


def test_a_sample_that_does_not_fit_is_refused_until_the_frame_is_sent(harness: Path) -> None:
    start = setup_commands("description_servo")
    answers = ask(harness, *start, "add 100 1 2 3 0", "add 65736 4 5 6 0", "samples", "add 65736 4 5 6 0", "samples")
    assert [answers[1], answers[2], answers[4]] == ["1", "0", "1"]
    assert ask(harness, *start, "add 100 1 2 3 0", "add 100 4 5 6 0")[-1] == "0"
    full = [f"add {1000 * k} 1 2 3 0" for k in range(93)]
    assert ask(harness, *start, *full)[-2:] == ["92", "0"]  # (1024 - 12) // 11 samples of 11 bytes
    assert ask(harness, "init 0") == ["-1"]


def test_our_decoder_reads_it_with_a_skip(harness: Path) -> None:
    answers = ask(
        harness,
        *setup_commands("description_servo"),
        "description",
        "add 1000 1 2 3 0",
        "add 2000 1 2 3 4",
        "samples",
        "skip 5",
        "add 8000 1 2 3 0",
        "samples",
    )
    decoder = BinaryDecoder()
    block = decoder.feed(bytes.fromhex("".join(a for a in answers if len(a) > 2)))
    assert block is not None
    assert block.sequence.tolist() == [0, 1, 7]
    assert block.time_s.tolist() == [0.001, 0.002, 0.008]
    assert block.quality.tolist() == [0, Quality.CURRENT_INVALID, Quality.GAP_BEFORE]
    assert decoder.counters.samples_lost == 5


def test_the_example_device_is_read_without_a_loss(tmp_path: Path) -> None:
    program = compile_c(FIRMWARE / "example.c", tmp_path / "example")
    stream = subprocess.run([program], capture_output=True, check=True).stdout
    decoder = BinaryDecoder()
    block = decoder.feed(stream)
    assert block is not None and decoder.description is not None
    assert decoder.description.identity == "EXAMPLE-0001"
    assert block.sequence.tolist() == list(range(3000))
    assert block.voltage_V is not None and block.position_rad is not None
    np.testing.assert_allclose(np.abs(block.voltage_V), 6.0, rtol=1e-12)
    assert block.position_rad.max() == pytest.approx(2 * np.pi * 4000 / 4096)
    assert (decoder.counters.crc_errors, decoder.counters.framing_errors) == (0, 0)


def test_the_sketch_speaks_the_text_wire(tmp_path: Path) -> None:
    compiler = shutil.which("g++") or shutil.which("c++")
    if compiler is None:
        pytest.skip("no C++ compiler (g++ or c++) on this machine")
    program, stub = tmp_path / "sketch", Path(__file__).with_name("arduino_stub.h")
    command = [compiler, "-x", "c++", "-include", stub, "-o", program, FIRMWARE / "servo_text.ino"]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    lines = subprocess.run([program], capture_output=True, check=True).stdout
    decoder = TextDecoder(2 * 600.0)
    block = decoder.feed(b"\n" + lines)
    assert block is not None and len(block) == 5
    assert decoder.counters.framing_errors == 0 and not block.quality.any()
    assert block.voltage_V is not None and block.position_rad is not None
    np.testing.assert_allclose(np.diff(block.time_s)[1:], 2e-3, atol=3e-4)
    assert block.voltage_V[0] == pytest.approx(24 * 501 / 1023, abs=1e-3)
    np.testing.assert_allclose(block.position_rad, -np.arange(1, 6) * 2 * np.pi / 1200, rtol=1e-12)


def test_the_firmware_follows_commands_as_the_simulated_drive_does(harness: Path) -> None:
    """Any commands at any time: the same voltages and numbers, sample by sample."""
    noise, output = random.Random(5), CommandedOutput(SERVO, 1000.0, 24.0)
    asks, expected, number = setup_commands("description_servo"), [], 65520
    for k in range(3000):
        if noise.random() < 0.1:
            number = noise.choice((number, *5 * (number + 1,), number + 2, number - 1)) % 65536 or 1
            command = Command(
                7, 1 + (noise.random() < 0.05), number, noise.random() < 0.98, noise.choice((0, 3, 20, 50, 255)),
                noise.choice((*3 * (0.0,), *6 * (1.5, -2.5), 25.0)),
            )  # fmt: skip
            wire = bytearray(encode_frame(encode_command(command)))
            if noise.random() < 0.1:
                wire[noise.randrange(len(wire))] ^= 4
            output.hear(bytes(wire))
            asks.append(f"hear {1000 * k} {wire.hex()}")
        voltage, numbers = output.next(1)
        asks.append(f"voltage {1000 * k}")
        expected.append((int(numbers[0]), float(voltage[0])))
    answers = [(int(n), float(v)) for n, v in (line.split() for line in ask(harness, *asks)[1:])]
    assert answers == expected
    assert sum(v != 0.0 for _, v in expected) > 200 and sum(n == 0 for n, _ in expected) > 200


def test_the_commanded_example_stops_by_itself(tmp_path: Path) -> None:
    program = compile_c(FIRMWARE / "example_commanded.c", tmp_path / "commanded")
    commands = [Command(7, 1, k + 1, True, 255, 0.0 if k == 0 else 3.0) for k in range(200)]
    wire = b"".join(encode_frame(encode_command(c)) for c in commands)
    stream = subprocess.run([program], input=wire, capture_output=True, check=True).stdout
    block = BinaryDecoder().feed(stream)
    assert block is not None and block.voltage_V is not None and block.position_rad is not None
    assert block.voltage_V.tolist() == [0.0] + [3.0] * (199 + 49) + [0.0] * 751
    assert block.position_rad[-1] > 1.0
