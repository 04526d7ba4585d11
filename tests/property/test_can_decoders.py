"""The CAN decoders under anything: typed results only, back in step with the next good frames, and the same samples
however the frames are cut into batches."""

from __future__ import annotations

import itertools
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.base import DriverCounters
from drivers.can.decode import FrameBatch, load_dbc
from drivers.can.map import parse_signal_map
from drivers.can.ours.own import OwnDecoder
from drivers.can.vendor import VendorDecoder
from servo_daemon.samples import SampleBlock
from servo_daemon.sim_drive.can_frames import FrameEncoder
from tests.can_tools import RampSource, batch, frames_of

OWN_IDS = (0x101, 0x121, 0x681)
DBC = """
VERSION ""
NS_ :
BS_:
BU_: X
BO_ 1 A: 8 X
 SG_ Kind M : 0|8@1+ (1,0) [0|0] "" X
 SG_ Real m1 : 8|32@1- (1,0) [0|0] "" X
 SG_ Whole m2 : 15|16@0- (0.5,3) [0|0] "" X
BO_ 2 B: 8 X
 SG_ Long : 0|64@1- (1,0) [0|0] "" X
BO_ 3 C: 8 X
 SG_ Position : 0|16@1+ (1,0) [0|0] "" X
 SG_ Time : 16|32@1- (1,0) [0|0] "s" X
 SG_ Count : 48|16@1+ (1,0) [0|0] "" X
SIG_VALTYPE_ 1 Real : 1;
SIG_VALTYPE_ 2 Long : 2;
SIG_VALTYPE_ 3 Time : 1;
"""


@cache
def good_frames() -> list[list[tuple[int, bytes]]]:
    """What a drive sends of 1500 samples, ten at a time."""
    sent = frames_of(RampSource(start_us=777_000), 1500)
    return [[(f.frame_id, f.data) for f in some] for _, some in itertools.groupby(sent, lambda f: f.sample // 10)]


def vendor(device_time: bool) -> VendorDecoder:
    with tempfile.NamedTemporaryFile("w", suffix=".dbc") as file:
        file.write(DBC)
        file.flush()
        database = load_dbc(Path(file.name))
    signals = {
        "position_counts": "C.Position",
        "current_A": "A.Real",
        "voltage_V": {"formula": "X / Y + X * X", "X": "A.Whole", "Y": "B.Long"},
        "torque_Nm": {"signal": "B.Long", "scale": 1e200},
    }
    if device_time:
        signals |= {"time_s": {"signal": "C.Time", "scale": 1e30}, "sequence": "C.Count"}
    return VendorDecoder(parse_signal_map(signals, database, "x"), DriverCounters(), counts_per_rev=100, period_s=1e-3)


def check(blocks: list[SampleBlock]) -> None:
    for block in blocks:
        assert len(block) > 0
        assert np.isfinite(block.time_s).all()
        assert (np.diff(block.time_s) > 0).all()
        assert (np.diff(block.sequence) > 0).all()


def frames(ids: tuple[int, ...]) -> st.SearchStrategy[list[list[tuple[int, bytes]]]]:
    frame = st.tuples(st.sampled_from((*ids, 0x7FF)), st.binary(min_size=8, max_size=8) | st.binary(max_size=8))
    return st.lists(st.lists(frame, min_size=1, max_size=12), max_size=8)


@settings(derandomize=True, max_examples=60, deadline=None)
@given(batches=frames(OWN_IDS), waits=st.lists(st.sampled_from([0.0, 0.01, 0.04, 5.0]), min_size=9, max_size=9))
def test_own_frames_with_any_content(batches: list[list[tuple[int, bytes]]], waits: list[float]) -> None:
    """Whatever came before: once the drive itself is heard, every further sample is there and dated right."""
    counters = DriverCounters()
    decoder = OwnDecoder(1, counters)
    host_s = 10.0
    for content, wait_s in zip(batches, waits, strict=False):
        host_s += wait_s
        check(decoder.feed(batch(content, host_s)))
    blocks = []
    for some in good_frames():
        host_s += 0.01
        blocks += decoder.feed(batch(some, host_s))
    check(blocks)
    time_s = np.concatenate([b.time_s for b in blocks])[-1000:]
    assert np.allclose(time_s % 2**32, 0.777 + 1e-3 * np.arange(500, 1500), rtol=0, atol=1e-6)
    tail = np.concatenate([b.quality for b in blocks])[-1000:]
    assert not tail.any()


@settings(derandomize=True, max_examples=150, deadline=None)
@given(batches=frames((1, 2, 3)), device_time=st.booleans(), waits=st.lists(st.floats(0, 10), min_size=9, max_size=9))
def test_vendor_frames_with_any_content(
    batches: list[list[tuple[int, bytes]]], device_time: bool, waits: list[float]
) -> None:
    decoder = vendor(device_time)
    host_s = 10.0
    for content, wait_s in zip(batches, waits, strict=False):
        host_s += wait_s
        check(decoder.feed(batch(content, host_s, [host_s] * len(content))))


@settings(derandomize=True, max_examples=40, deadline=None)
@given(
    cuts=st.sets(st.integers(1, 400)), restart_at=st.integers(10, 300), lost=st.sets(st.integers(0, 399), max_size=20)
)
def test_own_samples_do_not_depend_on_the_batches(cuts: set[int], restart_at: int, lost: set[int]) -> None:
    """Bit for bit; the frames arrive in time, so the host's clock decides nothing. (A device that restarts within
    8 ms of its start cannot be told from one that repeats itself.)"""
    source = RampSource(counts_per_sample=321)
    encoder = FrameEncoder(source.info, 1)
    good = encoder.encode(source.next_block(restart_at))
    encoder.restart()
    good += encoder.encode(source.next_block(400 - restart_at))
    good = [f for f in good if f.sample not in lost]

    def decoded(edges: list[int]) -> list[np.ndarray]:
        decoder = OwnDecoder(1, DriverCounters())
        blocks: list[SampleBlock] = []
        for a, b in zip([0, *edges], [*edges, len(good)], strict=True):
            if a < b:
                some = good[a:b]
                blocks += decoder.feed(batch([(f.frame_id, f.data) for f in some], 1.0 + 1e-3 * some[-1].sample))
        names = ("time_s", "sequence", "quality", "voltage_V", "current_A", "position_rad")
        return [np.concatenate([getattr(b, name) for b in blocks]) for name in names]

    edges = sorted(c for c in cuts if c < len(good))
    for whole, parts in zip(decoded([]), decoded(edges), strict=True):
        assert np.array_equal(whole, parts)


class Carefully(OwnDecoder):
    """Without the way for the common case."""

    def _steady(self, batch: FrameBatch) -> SampleBlock | None:
        return None


@settings(derandomize=True, max_examples=100, deadline=None)
@given(
    together=st.integers(3, 60),
    lost=st.sets(st.integers(0, 419), max_size=3),
    twice=st.sets(st.integers(0, 419), max_size=3),
    spoiled=st.dictionaries(st.integers(0, 419), st.tuples(st.integers(0, 7), st.integers(1, 255)), max_size=3),
    silences=st.dictionaries(st.integers(0, 29), st.sampled_from([0.06, 5.0]), max_size=2),
    restart_at=st.integers(10, 390),
    speed=st.sampled_from([0, 7, -3001, 32_767, -32_768]),
    start_us=st.sampled_from([0, 60_000, 2**32 - 150_000]),
)
def test_the_common_case_is_no_case_of_its_own(
    together: int,
    lost: set[int],
    twice: set[int],
    spoiled: dict[int, tuple[int, int]],
    silences: dict[int, float],
    restart_at: int,
    speed: int,
    start_us: int,
) -> None:
    """Whatever is lost, repeated or spoiled and whenever the host looks: the quick way gives what the careful one does,
    block for block and bit for bit, and counts the same. (Voltage and current pass through all their values.)"""
    source = RampSource(counts_per_sample=speed, start_us=start_us, start_counts=2**31 - 200 * abs(speed))
    encoder = FrameEncoder(replace(source.info, voltage_lsb_V=3e-4), 1)
    sent = encoder.encode(source.next_block(restart_at))
    encoder.restart()
    sent += encoder.encode(source.next_block(400 - restart_at))
    heard: list[tuple[int, bytes]] = []
    for k, frame in enumerate(sent):
        data = bytearray(frame.data)
        if k in spoiled:
            data[spoiled[k][0]] ^= spoiled[k][1]
        heard += ([] if k in lost else [(frame.frame_id, bytes(data))]) * (2 if k in twice else 1)
    quick, careful = (kind(1, DriverCounters()) for kind in (OwnDecoder, Carefully))
    host_s = 1.0
    for k in range(-(-len(heard) // together)):
        some = heard[k * together : (k + 1) * together]
        host_s += 1e-3 * len(some) + silences.get(k, 0.0)
        blocks = [decoder.feed(batch(some, host_s)) for decoder in (quick, careful)]
        for one, other in zip(*blocks, strict=True):
            for name in ("time_s", "sequence", "quality", "voltage_V", "current_A", "position_rad"):
                assert np.array_equal(getattr(one, name), getattr(other, name), equal_nan=name.endswith(("V", "A")))
        assert quick._counters == careful._counters
        assert quick._timeline.last == careful._timeline.last


@settings(derandomize=True, max_examples=30, deadline=None)
@given(
    lost=st.sets(st.integers(0, 1300), max_size=4),
    short=st.sampled_from([None, 0x7FF, 0x122]),
    twice=st.booleans(),
    together=st.integers(10, 120),
)
def test_drives_that_are_received_together_do_not_touch_each_other(
    lost: set[int], short: int | None, twice: bool, together: int
) -> None:
    """Shares of one batch give each drive what its frames alone would, even if two listen to the same drive."""
    traffic = [f for n in (1, 2, 3) for f in frames_of(RampSource(counts_per_sample=-5_000 * n), 400, n)]
    traffic.sort(key=lambda f: f.sample)
    heard = [(f.frame_id, f.data) for k, f in enumerate(traffic) if k not in lost]
    if short is not None:
        heard[600:600] = [(short, b"abc")]
    ids = (1, 2, 3, 3) if twice else (1, 2, 3)
    sharing, alone = ([OwnDecoder(n, DriverCounters()) for n in ids] for _ in range(2))
    for first in range(0, len(heard), together):
        some, host_s = heard[first : first + together], 1.0 + 1e-3 * first / 3
        wanted = [[f for f in some if f[0] in decoder.keys or f[0] == 0x7FF] for decoder in sharing]
        if not (everything := [f for share in wanted for f in share]):
            continue
        whole, start = batch(everything, host_s), 0
        for one, other, share in zip(sharing, alone, wanted, strict=True):
            stop = start + len(share)
            if share:
                blocks = [one.feed(whole.share(start, stop)), other.feed(batch(share, host_s))]
                for a, b in zip(*blocks, strict=True):
                    assert np.array_equal(a.time_s, b.time_s)
                    assert np.array_equal(a.position_rad, b.position_rad)
                    assert np.array_equal(a.sequence, b.sequence)
            start = stop
            assert one._counters == other._counters


@settings(derandomize=True, max_examples=40, deadline=None)
@given(data=st.data(), cuts=st.sets(st.integers(1, 119)))
def test_vendor_samples_do_not_depend_on_the_batches(data: st.DataObject, cuts: set[int]) -> None:
    ids = data.draw(st.lists(st.sampled_from([1, 2, 3]), min_size=120, max_size=120))
    seed = data.draw(st.integers(0, 2**32 - 1))
    payloads = np.random.default_rng(seed).integers(0, 256, (120, 8), np.uint8)
    payloads[:, 2:6] = np.cumsum(np.ones((120, 1)), axis=0).astype("<f4").view(np.uint8).reshape(120, 4)
    stamps = 1000.0 + 1e-3 * np.arange(120)

    def decoded(edges: list[int]) -> list[np.ndarray]:
        decoder = vendor(device_time=bool(seed % 2))
        blocks: list[SampleBlock] = []
        for a, b in zip([0, *edges], [*edges, 120], strict=True):
            some = [(ids[k], payloads[k].tobytes()) for k in range(a, b)]
            blocks += decoder.feed(batch(some, stamps[b - 1], stamps[a:b].tolist()))
        names = ("time_s", "sequence", "quality", "voltage_V", "current_A", "position_rad", "torque_Nm")
        return [np.concatenate([getattr(b, name) for b in blocks] or [np.empty(0)]) for name in names]

    for whole, parts in zip(decoded([]), decoded(sorted(cuts)), strict=True):
        assert np.array_equal(whole, parts, equal_nan=True)
