"""One picture a scenario: each parameter's published value with its 95 % band against the truth, legible on a phone."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from servo_daemon.samples import F64
from tests.recovery.tracking.cases import Case
from tests.recovery.tracking.follow import Z95, Flags, Track, sampled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: What the axes show: unit and how many of it make one SI unit.
UNITS = {
    "R": ("Ω", 1.0),
    "L": ("H", 1.0),
    "K": ("N·m/A", 1.0),
    "J": ("g·m²", 1e3),
    "B": ("N·m·s/rad", 1.0),
    "Tc": ("N·m", 1.0),
    "TL": ("N·m", 1.0),
}
WIDTH_IN, PANEL_IN, DPI = 4.6, 1.35, 110
COLOURS = 48
_VALUE, _OTHER, _TRUTH, _BAND, _ALARM = "#1f5fa8", "#9a9a9a", "#111111", "#a9c8ec", "#c02020"
#: Engineering prefixes for the axes.
_PREFIX = {-6: "µ", -3: "m", 0: "", 3: "k"}


def plot_case(directory: Path, name: str, motor: str, case: Case, track: Track) -> Path:
    """Writes directory/scenario-name.png; returns where."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    directory.mkdir(parents=True, exist_ok=True)
    count = len(track.names)
    figure, axes = pyplot.subplots(
        count, 1, sharex=True, figsize=(WIDTH_IN, 1.1 + PANEL_IN * count), layout="constrained"
    )
    truth = sampled(case.truth, case.recording.truth.time_s, track.names, track.time_s)
    for p, parameter in enumerate(track.names):
        _panel(axes[p], parameter, track, p, truth[:, p])
        _moments(axes[p], case, track, parameter)
    axes[-1].set_xlabel("time, s")
    motion = case.motion.replace("_", " ")
    figure.suptitle(f"{name}\nmotor: {motor}; motion: {motion}", fontsize=9.5, x=0.03, horizontalalignment="left")
    _mismatch(axes[0], track)
    _legend(figure, axes[0])
    path = directory / f"{re.sub('[^a-z0-9]+', '-', name.lower()).strip('-')}.png"
    _save(figure, path)
    pyplot.close(figure)
    return path


def _panel(axis: Axes, parameter: str, track: Track, p: int, truth: F64) -> None:
    unit, per_si = UNITS[parameter]
    power = _power(truth * per_si)
    unit, size = f"{_PREFIX[power]}{unit}", 10.0**power / per_si
    value, std, tracking = track.value[:, p] / size, track.std[:, p] / size, track.tracking[:, p]
    shown = np.where(tracking, value, np.nan)
    low, high = shown - Z95 * std, shown + Z95 * std
    axis.fill_between(track.time_s, low, high, color=_BAND, linewidth=0, label="95 % band")
    axis.plot(
        track.time_s, np.where(_widened(~tracking), value, np.nan), color=_OTHER, linewidth=1.0, label="not tracking"
    )
    axis.plot(track.time_s, shown, color=_VALUE, linewidth=1.1, label="tracking")
    axis.plot(track.time_s, truth / size, color=_TRUTH, linewidth=0.9, linestyle=(0, (4, 2)), label="truth")
    axis.set_ylim(*_limits(value, np.where(tracking, std, np.nan), truth / size))
    axis.set_ylabel(f"{parameter}, {unit}", fontsize=9)
    axis.tick_params(labelsize=8)
    axis.grid(color="#dddddd", linewidth=0.5)
    axis.margins(x=0.01)


def _moments(axis: Axes, case: Case, track: Track, parameter: str) -> None:
    """The change as a dotted line, a jump that was reported of this parameter as a red one."""
    if case.change_s is not None:
        axis.axvline(case.change_s, color="#777777", linewidth=0.8, linestyle=":")
    for told in track.told:
        if told.data.get("parameter") == parameter and ("jump" in told.kind or "step" in told.kind):
            axis.axvline(told.time_s, color=_ALARM, linewidth=0.9)


def _mismatch(axis: Axes, track: Track) -> None:
    """A bar along the top while the innovations are not white."""
    across = axis.get_xaxis_transform()
    axis.fill_between(
        track.time_s, 0.95, 1.0, where=~track.white, transform=across, color=_ALARM, linewidth=0, label="not white"
    )


def _limits(value: F64, std: F64, truth: F64) -> tuple[float, float]:
    """The truth, and what most of the values and bands need, so that a wild start does not flatten the rest."""
    inner = np.concatenate([value, value - Z95 * std, value + Z95 * std])
    inner = inner[np.isfinite(inner)]
    low, high = float(truth.min()), float(truth.max())
    if len(inner):
        low, high = min(low, float(np.quantile(inner, 0.03))), max(high, float(np.quantile(inner, 0.97)))
    room = max(0.08 * (high - low), 0.004 * max(abs(low), abs(high)), 1e-12)
    return low - room, high + room


def _power(truth: F64) -> int:
    """Power of ten of the axis's prefix."""
    largest = float(np.abs(truth).max())
    exponent = 0 if largest == 0 else 3 * int(np.floor(np.log10(largest * 1.001) / 3))
    return min(max(exponent, min(_PREFIX)), max(_PREFIX))


def _widened(flags: Flags) -> Flags:
    """With one more at either end, so that the grey line meets the blue one."""
    return flags | np.roll(flags, 1) | np.roll(flags, -1)


def _legend(figure: Figure, axis: Axes) -> None:
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)


def _save(figure: Figure, path: Path) -> None:
    """As a PNG of few colours: a quarter of the size."""
    from PIL import Image

    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    buffer.seek(0)
    with Image.open(buffer) as image:
        image.convert("RGB").quantize(COLOURS, method=Image.Quantize.MEDIANCUT).save(path, optimize=True)
