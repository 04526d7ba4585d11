"""MCAP files: our own there and back, and those of ROS 2, whose JointState is written here by its definition."""

from __future__ import annotations

import json
import struct
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from servo_daemon.captures import Capture, CaptureWriter, read_capture, write_capture
from servo_daemon.captures.capture.read_options import ReadOptions
from servo_daemon.errors import BadInputError, CaptureError
from servo_daemon.samples import make_block
from tests.command_line import run_command

N, T0_NS = 200, 1_795_262_400_000_000_000
T = np.arange(N) * 0.001
U, A, Q = np.sin(T * 90), np.cos(T * 70), T * 3.0
JOINT_STATE = "sensor_msgs/msg/JointState"


def ours(path: Path, **metadata: str) -> Path:
    write_capture(path, make_block(T, voltage_V=U, current_A=A, position_rad=Q), metadata=metadata)
    return path


def stamp(k: int) -> int:
    return T0_NS + 1_000_000 * k


def cdr(k: int, joints: Iterable[str], columns: dict[str, Any], order: str = "<") -> bytes:
    """A JointState as a ROS 2 node writes it; `columns`: shape (N, joints)."""
    body = b""

    def put(kind: str, *values: Any) -> None:
        nonlocal body
        body += b"\0" * (-len(body) % struct.calcsize(f"={kind[-1]}")) + struct.pack(order + kind, *values)

    def text(word: str) -> None:
        put("I", len(word) + 1)
        put(f"{len(word) + 1}s", word.encode() + b"\0")

    put("i", stamp(k) // 10**9)
    put("I", stamp(k) % 10**9)
    text("base")
    put("I", len(list(joints)))
    for name in joints:
        text(name)
    for field in ("position", "velocity", "effort"):
        values = columns.get(field)
        put("I", 0 if values is None else len(values[k]))
        for value in () if values is None else values[k]:
            put("d", value)
    return (b"\0\1\0\0" if order == "<" else b"\0\0\0\0") + body


def recording(
    path: Path, *channels: tuple[str, str, str, Iterable[bytes]], compression: CompressionType = CompressionType.ZSTD
) -> Path:
    """Channels of (topic, schema, encoding, messages)."""
    with path.open("wb") as file:
        writer = Writer(file, compression=compression)
        writer.start(profile="ros2", library="test")
        for topic, schema, encoding, messages in channels:
            number = writer.register_schema(schema, "ros2msg", b"")
            channel = writer.register_channel(topic, encoding, number)
            for k, data in enumerate(messages):
                # Logged late and unevenly: the header's stamp counts.
                writer.add_message(channel, stamp(k) + 7_000_000 * (k % 3), data, 0, k)
        writer.finish()
    return path


def robot(path: Path, joints: tuple[str, ...] = ("hip", "knee"), order: str = "<", **options: Any) -> Path:
    columns = {
        "position": np.stack([Q + j for j in range(len(joints))], 1),
        "velocity": np.stack([np.full(N, 3.0) + j for j in range(len(joints))], 1),
        "effort": np.stack([A + j for j in range(len(joints))], 1),
    }
    messages = [cdr(k, joints, columns, order) for k in range(N)]
    return recording(path, ("/joint_states", JOINT_STATE, "cdr", messages), **options)


def same(capture: Capture, **columns: Any) -> None:
    for name, values in columns.items():
        assert np.array_equal(getattr(capture, name), values), name


def test_our_own_come_back_to_the_last_bit(tmp_path: Path) -> None:
    written = ours(tmp_path / "a.mcap", drive="axis-1", mass_kg="0.49")
    capture = read_capture(written)
    same(capture, time_s=T, voltage_V=U, current_A=A, position_rad=Q)
    assert capture.metadata["mass_kg"] == "0.49" and capture.axis == "rotary"
    with written.open("rb") as file:  # as any other reader sees it
        found = list(make_reader(file).iter_messages())
    schema, channel, last = found[-1]
    assert schema is not None and (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
    assert channel.topic == "/servo_daemon/axis-1" and channel.metadata["mass_kg"] == "0.49"
    properties = json.loads(schema.data)["properties"]
    assert set(json.loads(last.data)) == set(properties) == {"time_s", "voltage_V", "current_A", "position_rad"}
    stamps = np.array([m.log_time for _, _, m in found])
    assert np.array_equal(np.diff(stamps), np.full(N - 1, 1_000_000)), "log_time in ns"
    assert stamps[-1] > T0_NS / 2, "of this machine's clock"


def test_a_linear_axis_and_blocks(tmp_path: Path) -> None:
    with CaptureWriter(tmp_path / "noname", axis="linear", kind="mcap") as writer:
        block = make_block(T, torque_Nm=A, position_rad=Q)
        writer.write(block.slice(0, 50))
        writer.write(block.slice(50, N))
    capture = read_capture(tmp_path / "noname")
    assert capture.axis == "linear"
    same(capture, time_s=T, torque_Nm=A, position_rad=Q)
    with pytest.raises(CaptureError, match=r"a\.csv: this is the name of a csv file, not of mcap"):
        CaptureWriter(tmp_path / "a.csv", kind="mcap")


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE])
def test_a_joint_of_ros_2(tmp_path: Path, order: str, compression: CompressionType) -> None:
    path = robot(tmp_path / "a.mcap", order=order, compression=compression)
    capture = read_capture(path, options=ReadOptions(joint="knee", effort="current"))
    same(capture, position_rad=Q + 1, velocity_rad_s=np.full(N, 4.0), current_A=A + 1)
    assert capture.time_s == pytest.approx(T, abs=1e-12) and capture.torque_Nm is None
    torque = read_capture(path, options=ReadOptions(joint="hip", effort="torque"))
    same(torque, torque_Nm=A, position_rad=Q)
    force = read_capture(path, options=ReadOptions(joint="hip", effort="force"))
    assert force.axis == "linear"


def test_what_has_to_be_told_is_asked(tmp_path: Path) -> None:
    path = robot(tmp_path / "a.mcap")
    with pytest.raises(CaptureError, match=r"several joints: hip, knee: --joint NAME"):
        read_capture(path)
    with pytest.raises(CaptureError, match=r"no joint 'ankle'; there are hip, knee"):
        read_capture(path, options=ReadOptions(joint="ankle"))
    with pytest.raises(CaptureError, match=r"hip\.effort may be a current or a torque: --effort current\|torque"):
        read_capture(path, options=ReadOptions(joint="hip"))
    (tmp_path / "map.toml").write_text('[signals]\nposition_rad = "hip.position"\ncurrent_A = "knee.effort"\n')
    same(read_capture(path, tmp_path / "map.toml"), position_rad=Q, current_A=A + 1)
    alone = robot(tmp_path / "b.mcap", joints=("hip",))
    same(read_capture(alone, options=ReadOptions(effort="torque")), torque_Nm=A)


def test_json_as_bridges_write_it(tmp_path: Path) -> None:
    """A JointState as JSON (effort and velocity may be empty), and a supply's voltage on another topic."""

    def state(k: int) -> bytes:
        header = {"stamp": {"sec": stamp(k) // 10**9, "nanosec": stamp(k) % 10**9}, "frame_id": ""}
        return json.dumps({"header": header, "name": ["j"], "position": [Q[k]], "velocity": [], "effort": []}).encode()

    volts = (json.dumps({"stamp": "none", "motor": {"voltage_V": U[k]}}).encode() for k in range(N))
    path = recording(
        tmp_path / "a.mcap",
        ("/joints", "sensor_msgs/JointState", "json", map(state, range(N))),
        ("/power", "mine/Power", "json", volts),
        ("/camera", "sensor_msgs/msg/Image", "cdr", [b"\0\1\0\0"] * 3),
    )
    (tmp_path / "map.toml").write_text(
        '[signals]\nposition_rad = "/joints.j.position"\nvoltage_V = "/power.motor.voltage_V"\n'
    )
    capture = read_capture(path, tmp_path / "map.toml")
    assert capture.position_rad is not None and np.isin(capture.position_rad, Q).all() and len(capture.time_s) > N / 2


def test_several_drives_of_ours(tmp_path: Path) -> None:
    rows = [json.dumps({"time_s": T[k], "voltage_V": U[k], "position_rad": Q[k]}).encode() for k in range(N)]
    other = [json.dumps({"time_s": T[k], "voltage_V": A[k], "position_rad": Q[k]}).encode() for k in range(N)]
    channels = [(f"/servo_daemon/{name}", "servo_daemon.Sample", "json", r) for name, r in (("x", rows), ("y", other))]
    path = recording(tmp_path / "a.mcap", *channels)
    same(read_capture(path, options=ReadOptions(joint="y")), voltage_V=A, time_s=T)
    with pytest.raises(CaptureError, match="several drives: x, y: --joint says which"):
        read_capture(path)


def test_a_file_that_is_cut_off_or_damaged(tmp_path: Path) -> None:
    path = recording(tmp_path / "a.mcap", ("/camera", "sensor_msgs/msg/Image", "cdr", [b"\0\1\0\0"] * 3))
    with pytest.raises(CaptureError, match=r"no 2 messages .*; it holds /camera \(sensor_msgs/msg/Image\)"):
        read_capture(path)
    with pytest.raises(CaptureError, match=r"/j, message 1: cut off"):
        read_capture(recording(tmp_path / "b.mcap", ("/j", JOINT_STATE, "cdr", [cdr(0, ["a"], {})[:-6]])))
    with pytest.raises(CaptureError, match=r"/j, message 1: a length of 4294967295"):
        read_capture(recording(tmp_path / "b.mcap", ("/j", JOINT_STATE, "cdr", [b"\0\1\0\0" + b"\xff" * 40])))
    whole = ours(tmp_path / "c.mcap").read_bytes()
    cut = tmp_path / "d.mcap"
    cut.write_bytes(whole[:-40])  # within the summary: a recorder that was killed
    capture = read_capture(cut)
    same(capture, time_s=T)
    assert any("cut off" in note for note in capture.notes)
    damaged = bytearray(whole)
    damaged[len(whole) // 3] ^= 0xFF
    cut.write_bytes(damaged)
    with pytest.raises(CaptureError, match="not a usable MCAP file"):
        read_capture(cut)


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_a_chunk_never_becomes_larger_than_it_says(tmp_path: Path, compression: CompressionType) -> None:
    path = recording(
        tmp_path / "a.mcap",
        ("/a", "x", "json", [b'{"a": 1, "b": "' + b" " * 5000 + b'"}'] * 99),
        compression=compression,
    )
    data = path.read_bytes()
    at = data.index(compression.name.lower().encode()) - 16  # uncompressed size, its CRC, the length of this name
    (size,) = struct.unpack_from("<Q", data, at)
    assert size > 99 * 5000
    path.write_bytes(data[:at] + struct.pack("<QI", 1000, 0) + data[at + 12 :])
    with pytest.raises(CaptureError, match="not a usable MCAP file, or cut off: a chunk"):
        read_capture(path)
    path.write_bytes(data[:at] + struct.pack("<QI", 1 << 40, 0) + data[at + 12 :])
    with pytest.raises(CaptureError, match="MB, unpacked: cut the capture up"):
        read_capture(path)


def test_the_extra_is_named_where_it_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = ours(tmp_path / "a.mcap")
    for module in ("writer", "stream_reader"):
        monkeypatch.setitem(sys.modules, f"mcap.{module}", None)
    with pytest.raises(BadInputError, match=r"servo-daemon\[mcap\]"):
        read_capture(path)
    with pytest.raises(BadInputError, match=r"servo-daemon\[mcap\]"):
        ours(tmp_path / "b.mcap")


def test_record_writes_it(tmp_path: Path) -> None:
    config = tmp_path / "c.toml"
    config.write_text("[[drive]]\n[drive.options]\nrealtime = false\n")
    shared = ("record", "--config", config, "--seconds", "0.2", "--out")
    recorded = run_command(*shared, tmp_path / "bench", "--format", "mcap")
    assert recorded.code == 0, recorded.err
    assert run_command(*shared, tmp_path / "a.csv").code == 0
    found, meant = read_capture(tmp_path / "bench"), read_capture(tmp_path / "a.csv")
    same(found, time_s=meant.time_s, voltage_V=meant.voltage_V, current_A=meant.current_A)
    assert found.metadata["driver"] == "simulated"
    wrong = run_command(*shared, tmp_path / "b.csv", "--format", "mcap")
    assert wrong.code == 2 and "the name of a csv file" in wrong.err
