"""Signals read in blocks against cantools' own decode, over random layouts: both byte orders, signed, floats,
multiplexed, classic and CAN FD."""

from __future__ import annotations

import math

import numpy as np
from cantools.database import Database
from cantools.database.can import Message, Signal
from cantools.database.conversion import BaseConversion
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.can.decode import Field, find_field, frame_key
from tests.can_tools import batch

N_FRAMES = 5


def sawtooth(start_from_top: int) -> int:
    """DBC number of the bit that is the nth from the top in big-endian order."""
    return 8 * (start_from_top // 8) + 7 - start_from_top % 8


@st.composite
def signals(draw: st.DrawFn, n_bits: int) -> Signal:
    is_float = draw(st.booleans())
    length = draw(st.sampled_from([16, 32, 64])) if is_float else draw(st.integers(1, 64))
    first = draw(st.integers(0, n_bits - length))
    big = draw(st.booleans())
    scale = draw(st.sampled_from([1, 0.001, -2.5, 1e-9]))
    return Signal(
        name="S",
        start=sawtooth(first) if big else first,
        length=length,
        byte_order="big_endian" if big else "little_endian",
        is_signed=draw(st.booleans()),
        conversion=BaseConversion.factory(scale=scale, offset=draw(st.sampled_from([0, 40, -1.5])), is_float=is_float),
    )


def database(signal_list: list[Signal], length: int = 8, extended: bool = False) -> Database:
    message = Message(0x123, "M", length, signal_list, is_extended_frame=extended, strict=True, is_fd=length > 8)
    return Database([message])


def same(ours: float, theirs: float) -> bool:
    if math.isnan(theirs) or math.isinf(theirs):
        return not math.isfinite(ours)
    return math.isclose(ours, theirs, rel_tol=1e-12, abs_tol=1e-300)


def fits_eight_bytes(signal: Signal) -> bool:
    """Signals of CAN FD messages that spread over nine bytes are refused, see `test_can_map`."""
    in_byte = signal.start % 8
    return (7 - in_byte if signal.byte_order == "big_endian" else in_byte) + signal.length <= 64


@settings(derandomize=True, max_examples=300, deadline=None)
@given(data=st.data(), extended=st.booleans(), fd=st.booleans())
def test_a_signal_is_what_cantools_says(data: st.DataObject, extended: bool, fd: bool) -> None:
    length = 64 if fd else 8
    signal = data.draw(signals(8 * length).filter(lambda s: not fd or fits_eight_bytes(s)))
    payloads = data.draw(st.lists(st.binary(min_size=length, max_size=length), min_size=1, max_size=N_FRAMES))
    db = database([signal], length, extended)
    field: Field = find_field(db, "M.S", "test")
    key = frame_key(0x123, extended)
    assert field.key == key
    frames = np.frombuffer(b"".join(payloads), np.uint8).reshape(-1, length)
    for ours, payload in zip(field.physical(frames), payloads, strict=True):
        theirs = db.decode_message("M", payload, decode_choices=False)["S"]
        assert same(float(ours), float(theirs)), (signal, payload.hex())


@settings(derandomize=True, max_examples=150, deadline=None)
@given(
    payloads=st.lists(st.binary(min_size=8, max_size=8), min_size=1, max_size=20),
    chosen=st.sets(st.integers(0, 3), min_size=1),
    inner=st.sets(st.integers(0, 1), min_size=1),
)
def test_a_multiplexed_signal_is_there_where_cantools_finds_it(
    payloads: list[bytes], chosen: set[int], inner: set[int]
) -> None:
    """Two multiplexers deep."""
    layout = [
        Signal("Outer", 0, 2, is_multiplexer=True),
        Signal("Inner", 8, 1, is_multiplexer=True, multiplexer_signal="Outer", multiplexer_ids=sorted(chosen)),
        Signal("S", 16, 32, multiplexer_signal="Inner", multiplexer_ids=sorted(inner), is_signed=True),
    ]
    # cantools wants a layout for every value a frame may carry
    layout += [
        Signal(f"Else{v}", 40, 4, multiplexer_signal="Outer", multiplexer_ids=[v]) for v in range(4) if v not in chosen
    ]
    layout += [
        Signal(f"Other{v}", 56, 4, multiplexer_signal="Inner", multiplexer_ids=[v]) for v in range(2) if v not in inner
    ]
    db = database(layout)
    field = find_field(db, "M.S", "test")
    frames = np.frombuffer(b"".join(payloads), np.uint8).reshape(-1, 8)
    for there, value, payload in zip(field.present(frames), field.physical(frames), payloads, strict=True):
        theirs = db.decode_message(0x123, payload, decode_choices=False)
        assert there == ("S" in theirs)
        if there:
            assert value == theirs["S"]


@settings(derandomize=True, max_examples=100, deadline=None)
@given(payloads=st.lists(st.binary(max_size=8), min_size=1, max_size=20))
def test_frames_of_any_length_become_rows(payloads: list[bytes]) -> None:
    frames = batch([(0x1, p) for p in payloads], 1.0)
    assert frames.lengths.tolist() == [len(p) for p in payloads]
    assert [bytes(row) for row in frames.data] == [p.ljust(8, b"\0") for p in payloads]
