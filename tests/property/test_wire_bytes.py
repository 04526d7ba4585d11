"""Any bytes into every serial decoder: nothing raised, everything counted, and the next good frame is read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.serial.decoder import BinaryDecoder
from drivers.serial.encoder import BinaryEncoder
from drivers.serial.frame import encode_frame
from drivers.serial.text import TextDecoder, encode_lines
from drivers.serial.wire import FORMATS, Channel, Description, Quantity
from servo_daemon.samples import SampleBlock, concatenate, make_block
from tests.wire_tools import SERVO, describe, frame, frames

FAST = settings(derandomize=True, max_examples=60, deadline=None)

FATES = ["keep", "drop", "repeat", "corrupt", "cut", "noise"]

PIECES = st.lists(
    st.one_of(
        st.binary(max_size=60),
        st.integers(0, 30).map(lambda k: frame(10 * k)),
        st.integers(0, 30).map(lambda k: frame(10 * k)[:31]),
        st.integers(0, 3).map(lambda k: describe(replace(SERVO, session=k))),
        st.binary(min_size=1, max_size=60).map(encode_frame),  # good CRC, any content
        st.binary(max_size=60).map(lambda b: encode_frame(b"\x01\x07\x01" + b)),
        st.binary(max_size=60).map(lambda b: encode_frame(b"\x02\x07\x01\x01" + b)),
    ),
    max_size=25,
)


def cut(data: bytes, seed: int) -> list[bytes]:
    """The same bytes in reads of any size."""
    rng = np.random.default_rng(seed)
    edges = np.sort(rng.integers(0, len(data) + 1, size=rng.integers(0, 12)))
    return [data[a:b] for a, b in zip([0, *edges], [*edges, len(data)], strict=True)]


def read_all(decoder: BinaryDecoder | TextDecoder, parts: list[bytes]) -> list[SampleBlock]:
    """All blocks, checked against the contract of `feed`."""
    blocks = []
    last_time, last_number = -1.0, -1
    for part in parts:
        block = decoder.feed(part)
        while block is not None:
            assert len(block) > 0
            times, numbers = np.append(last_time, block.time_s), np.append(last_number, block.sequence)
            assert (np.diff(times) > 0).all() and (np.diff(numbers) > 0).all()
            last_time, last_number = times[-1], numbers[-1]
            for name in block.channels:
                assert np.isfinite(getattr(block, name)).all()
            blocks.append(block)
            block = decoder.feed(b"") if decoder.has_ready else None
    return blocks


def equal(a: list[SampleBlock], b: list[SampleBlock]) -> bool:
    """Whether two runs delivered the same samples, however they were blocked."""
    columns = ("time_s", "sequence", "quality", "voltage_V", "current_A", "position_rad")
    runs = [[tuple(getattr(x, c) for c in columns) for x in run] for run in (a, b)]
    flat = [
        [tuple(None if v is None else v[k] for v in block) for block in run for k in range(len(block[0]))]
        for run in runs
    ]
    return flat[0] == flat[1]


@FAST
@given(PIECES, st.integers(0, 2**32 - 1))
def test_binary_takes_any_bytes_and_resynchronises(pieces: list[bytes], seed: int) -> None:
    decoder = BinaryDecoder()
    read_all(decoder, cut(b"".join(pieces), seed))
    drive = 7 if decoder.description is None else decoder.description.drive_id
    fresh = replace(SERVO, drive_id=drive, session=99, identity="FRESH")
    after = [b"\0", describe(fresh), frame(5_000, description=fresh)]
    last = [b for part in after if (b := decoder.feed(part)) is not None]
    while decoder.has_ready:
        more = decoder.feed(b"")
        assert more is not None
        last.append(more)
    assert last[-1].voltage_V is not None
    np.testing.assert_allclose(last[-1].voltage_V[-10:], np.arange(10) * 1e-3, atol=1e-12)


@FAST
@given(PIECES, st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1))
def test_binary_result_does_not_depend_on_how_bytes_are_cut(pieces: list[bytes], one: int, two: int) -> None:
    data = describe() + b"".join(pieces) + b"".join(frames(400, 440))
    a, b = BinaryDecoder(), BinaryDecoder()
    assert equal(read_all(a, cut(data, one)), read_all(b, cut(data, two)))
    assert a.counters == b.counters


@FAST
@given(st.lists(st.sampled_from(FATES), min_size=5, max_size=40), st.data())
def test_every_undamaged_frame_arrives_once(fates: list[str], data: st.DataObject) -> None:
    """Whatever happens to the others; a cut frame may take the next with it."""
    wire, expected, spoilt = [describe()], [], False
    for k, fate in enumerate(fates):
        one = frame(10 * k)
        match fate:
            case "keep" | "repeat":
                wire += [one] * (2 if fate == "repeat" else 1)
                if not spoilt or fate == "repeat":
                    expected += range(10 * k, 10 * k + 10)
                spoilt = False
            case "corrupt":
                place = data.draw(st.integers(0, len(one) - 2))
                wire.append(one[:place] + bytes([one[place] % 255 + 1]) + one[place + 1 :])
                spoilt = False
            case "cut":
                wire.append(one[: data.draw(st.integers(1, len(one) - 2))])
                spoilt = True
            case "noise":
                wire.append(data.draw(st.binary(max_size=50)) + b"\0")
                spoilt = False
    decoder = BinaryDecoder()
    blocks = read_all(decoder, cut(b"".join(wire), 1))
    assert [int(s) for b in blocks for s in b.sequence] == expected
    assert decoder.counters.device_restarts == 0
    gaps = expected[-1] + 1 - expected[0] - len(expected) if expected else 0
    assert decoder.counters.samples_lost == gaps


@st.composite
def descriptions(draw: st.DrawFn) -> Description:
    """Any device with at least a voltage."""
    quantities = [1, *draw(st.lists(st.sampled_from([2, 3, 4, 5, 6, 16]), unique=True))]
    scale = st.integers(1, 10**7).map(lambda k: float(str(np.float32(k * 1e-6))))
    channels = tuple(Channel(q, draw(st.sampled_from(sorted(FORMATS))), draw(scale)) for q in quantities)
    return Description(draw(st.integers(0, 255)), draw(st.integers(0, 255)), channels, "ü", draw(st.integers(0, 10**9)))


@FAST
@given(descriptions(), st.integers(1, 200), st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1))
def test_what_is_encoded_is_decoded(description: Description, n: int, first: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    t_us = first + np.cumsum(rng.integers(1, 60_000 if seed % 7 else 90_000, size=n))
    t_us -= t_us[0] - t_us[0] % 2**32  # unwrapped time begins where the device's clock stands
    values = {}
    for quantity, name in ((1, "voltage_V"), (2, "current_A"), (3, "position_rad"), (4, "velocity_rad_s"),
                           (5, "temperature_C"), (6, "torque_Nm")):  # fmt: skip
        channel = description.channel(Quantity(quantity))
        if channel is not None:
            limits = np.iinfo(np.dtype(FORMATS[channel.format]))
            step = min(limits.max - limits.min, 1000) // 4
            raw = (
                np.cumsum(rng.integers(-step, step + 1, size=n))
                if quantity == 3
                else rng.integers(limits.min, limits.max, size=n, endpoint=True)
            )
            values[name] = raw * channel.unit_per_lsb
    source = make_block(t_us / 1e6, sequence=first + np.arange(n), **values)
    encoder = BinaryEncoder(description)
    decoder = BinaryDecoder()
    blocks = read_all(decoder, cut(encoder.describe() + b"".join(encoder.encode(source)), seed))
    result = concatenate(blocks)
    assert result.sequence.tolist() == source.sequence.tolist()
    np.testing.assert_allclose(result.time_s, source.time_s, rtol=0, atol=1e-9)
    for name, sent in values.items():
        got = getattr(result, name)
        moved = got[0] - sent[0] if name == "position_rad" else 0.0  # where the count began may be turns away
        np.testing.assert_allclose(got - moved, sent, rtol=1e-9, atol=1e-9)
    assert decoder.counters.samples_lost == 0


TEXT = st.lists(
    st.one_of(
        st.binary(max_size=40),
        st.text("0123456789,-\n\r#", max_size=40).map(str.encode),
        st.integers(0, 2**32).map(lambda t: b"%d,1,2,3\n" % t),
    ),
    max_size=25,
)


@FAST
@given(TEXT, st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1), st.sampled_from([None, 1e-3]))
def test_text_takes_any_bytes_however_cut(pieces: list[bytes], one: int, two: int, period_s: float | None) -> None:
    t = np.arange(1, 6) * 1e-3
    end = encode_lines(make_block(t, voltage_V=t, current_A=t, position_rad=t), 4096.0)
    data = b"\n" + b"".join(pieces) + b"\n\n" + end
    a, b = (TextDecoder(4096.0, sample_period_s=period_s) for _ in range(2))
    first, second = read_all(a, cut(data, one)), read_all(b, cut(data, two))
    assert equal(first, second)
    assert a.counters == b.counters
    assert sum(map(len, first)) >= 4
