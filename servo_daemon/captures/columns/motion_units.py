"""Units of an angle and a speed that both lack one: what they make of each other leaves few."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from servo_daemon.captures.columns.foreign import Recording
from servo_daemon.captures.columns.signal_map import SignalRef
from servo_daemon.captures.columns.understood import Understood
from servo_daemon.captures.meaning.units import common_factor
from servo_daemon.column_names import UNITS

#: Pairs that people write, the likeliest first; and how near to a pair's factor counts as it.
_PAIRS = (("rad", "rad_s"), ("deg", "deg_s"), ("turns", "rps"), ("deg", "rpm"), ("rad", "rpm"), ("turns", "rpm"))
_NEAR = 0.03


def match_motion(recording: Recording, found: Understood) -> None:
    """Asks about an angle and a speed by the units alone that go together, where the values tell these."""
    asked = {q.column: signal for signal, q in found.questions.items() if q.units}
    time, angle, speed = found.columns.get("time_s"), asked.get("position_rad"), asked.get("velocity_rad_s")
    if time is None or angle is None or speed is None:
        return
    t, x, w = (recording.read(SignalRef("value", name)).values for name in (time.operands[0].signal, angle, speed))
    if not all(np.isfinite(values).all() for values in (t, x, w)):
        return
    ratio = common_factor(x, w, np.diff(t * time.operands[0].scale))
    pairs = () if ratio is None else units_that_agree(ratio)
    if pairs:
        told = " or ".join(f"{a} with {b}" for a, b in pairs)
        for signal, of in ((angle, 0), (speed, 1)):
            question = found.questions[signal]
            text = f"{angle} and {speed}: their values fit {told}"
            found.questions[signal] = replace(question, text=text, units=tuple(dict.fromkeys(p[of] for p in pairs)))


def units_that_agree(ratio: float) -> tuple[tuple[str, str], ...]:
    """Units of an angle and of a speed that are both right or both wrong, the likeliest first; empty: none is known.

    Args:
        ratio: of the angle to the speed's integral, both as they are.
    """
    factors = ((pair, UNITS[pair[1].replace("_", "/")][1] / UNITS[pair[0]][1]) for pair in _PAIRS)
    return tuple(pair for pair, factor in factors if abs(ratio / factor - 1.0) < _NEAR)
