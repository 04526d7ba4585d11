"""What a fit's numbers say about the data they came from, in sentences for the user."""

from __future__ import annotations

from collections.abc import Mapping

from servo_daemon.captures import Capture
from servo_daemon.captures.meaning import (
    closes_as_it_stands,
    may_be_driven,
    no_sign_of_current,
    no_sign_of_speed,
    no_sign_of_voltage,
    shows_no_sign,
    takes_no_power,
    turned_voltage,
)
from servo_daemon.captures.meaning.finding import mend
from servo_daemon.captures.meaning.rows import rows_away
from servo_daemon.commands.shared.units import shown_column, shown_unit
from servo_daemon.conditioning.angle_scale import angle_hint
from servo_daemon.identification.output_error import OutputErrorFit
from servo_daemon.identification.output_error.discrepancy.lag_like import equivalents
from servo_daemon.identification.output_error.discrepancy.late_current import SAMPLES
from servo_daemon.identification.output_error.discrepancy.misfit import unexplained
from servo_daemon.identification.output_error.discrepancy.other_laws import friction_goes_one_way
from servo_daemon.identification.procedure.drift import SEGMENT_S, Drift
from servo_daemon.parameters import spaced
from servo_daemon.signal_meaning import SignalMeaning

#: An estimate further from its nominal value than this factor is no ageing: a unit, a sign, another motor.
_FAR = 10.0
#: What a column of one sign may be, and what to do then.
_MODULUS = {
    "current_A": "|i| (record the motor's voltage with it, which says its sign: `shows` in docs/captures.md)",
    "voltage_V": "|v| (a formula of the signal map gives it the sign of another column, docs/captures.md)",
}
#: What is said of a current that is a mean.
_MEAN = (
    "current_A is its mean over each row, not its value at it: R, L, K and J hold some of that, and their standard "
    "deviations. mend: a line  # current: mean  above the header, or  current = "
    '"mean"  under [metadata] of a signal map'
)


def result_notes(
    fit: OutputErrorFit,
    nominal: Mapping[str, float],
    meaning: SignalMeaning | None = None,
    capture: Capture | None = None,
) -> list[str]:
    """Remarks on estimates far from their nominal values, at a bound, and on how the input is taken.

    Args:
        nominal: all values that are given, held ones too.
        meaning: of the captures' signals; None: as they are by default.
        capture: one of them, for the line that mends it.
    """
    meaning = meaning or SignalMeaning()
    return [
        *_of_channels(fit, capture),
        *_of_values(fit, nominal, meaning.gear_ratio),
        *_of_input(fit, nominal, meaning),
    ]


def _of_channels(fit: OutputErrorFit, capture: Capture | None) -> list[str]:
    """Which channels the model does not explain or would need, and which are means, or late."""
    notes = [_unexplained(name, capture) for name in unexplained(fit)]
    notes += [
        f"no current is measured: all of the lag that was found is put down to {name}, and "
        f"{' or '.join(effects)} would look the same: give `--fix {name}=…`, or measure the current"
        for name, effects in equivalents(fit.problem).items()
    ]
    if fit.current_is_mean:
        notes.append(_MEAN)
    if (late_s := fit.current_late_s) is not None:
        notes.append(_late(late_s, fit.problem.sample_period_s))
    if fit.voltage_rows_late and capture is not None:
        notes.append(
            f"voltage_V seems to be written {rows_away(fit.voltage_rows_late)} beside the motion (a drive or a sensor "
            "that waits so long looks the same): what is said of J, L and the time constants is as open. "
            f"{mend(capture, 'voltage_V', {'rows_late': fit.voltage_rows_late})}"
        )
    return notes


def _of_values(fit: OutputErrorFit, nominal: Mapping[str, float], gear_ratio: float) -> list[str]:
    """Which values a bound, a nominal value far away or the kind of motion casts doubt on."""
    notes = []
    for name, p in fit.parameters.items():
        given = nominal.get(name)
        if p.bound is not None:
            notes.append(
                f"{name} ended at its physical bound, {p.bound:.3g}{spaced(p.unit)}: the data contradict the "
                "model or do not determine it"
            )
        if p.status != "estimated" or p.value is None:
            continue
        if given is not None and given > 0 and p.value > 0 and not 1 / _FAR < p.value / given < _FAR:
            notes.append(
                f"{name} = {p.value:.4g}{spaced(p.unit)} is {p.value / given:.3g} times its nominal value: "
                "is a column in another unit, or its sign turned?"
            )
    if fit.parameters["B"].status == "estimated" and friction_goes_one_way(fit):
        notes.append(
            "the motion never turns back: dry friction would look like B there, and B and J are known no better than "
            "that leaves them: record a motion to and fro"
        )
    estimated = {n: p.value for n, p in fit.parameters.items() if p.status == "estimated"}
    if (hint := angle_hint(estimated, nominal, gear_ratio)) is not None:
        notes.append(hint)
    return notes


def _of_input(fit: OutputErrorFit, nominal: Mapping[str, float], meaning: SignalMeaning) -> list[str]:
    """What it costs that an input is known at its samples only."""
    notes = []
    if fit.problem.plant.drive != "voltage" and meaning.current != "mean":
        what = "current" if fit.problem.plant.drive == "current" else "torque"
        notes.append(
            f"the {what} is taken as smooth between its samples; the standard deviations include the error of "
            "this (at most that of half a sample's delay)"
        )
    if fit.problem.plant.drive == "current" and "R" not in nominal and meaning.may_hold_voltage:
        lost, given_by = _held_voltage(fit)
        notes.append(
            f"if the drive holds its voltage for whole samples, J is too small by up to {lost}, which no residual "
            f"shows; its standard deviation includes that of a usual motor, with `--fix {given_by}` that of this one"
        )
    return notes


def _late(late_s: float, period_s: float) -> str:
    """What is said of a current that is behind. Within a row only a sensor mends it: a mean over much of one cannot be
    undone to better than some percent of R and J."""
    text = (
        f"current_A is {1e3 * late_s:.2g} ms behind voltage and motion, as a filter of its sensor or of the drive "
        "makes it: R, L and J hold some of that, and their standard deviations. mend:"
    )
    if late_s < SAMPLES * period_s:
        return f"{text} a sensor that takes its mean over less of the {1e3 * period_s:.3g} ms between two rows"
    return (
        f"{text} a line  # current_late_s: {late_s:.3g}  above the header, or  current_late_s = {late_s:.3g}  under "
        "[metadata] of a signal map"
    )


def _unexplained(name: str, capture: Capture | None) -> str:
    text = f"the model explains next to nothing of {name}, and no parameter has a value"
    if capture is None:
        return f"{text}: is its sign turned, or its unit wrong?"
    if (unsigned := _without_a_sign(name, capture)) is not None:
        return f"{text}: {unsigned}"
    if takes_no_power(capture, name):
        return f"{text}: {_against(name, capture)}"
    if (effort := shows_no_sign(capture)) is not None:
        return (
            f"{text}: either {effort} is {_MODULUS[effort]}, or the model lacks the load that holds it on one side "
            "(`--effect constant_load_torque`)"
        )
    return (
        f"{text}: the model lacks what moves it, a load or a friction (`servo-daemon diagnose {capture.path}` looks "
        "for it, `--effect NAME` adds it), or its unit is wrong"
    )


def _without_a_sign(name: str, capture: Capture) -> str | None:
    """What is said of a channel, or of the voltage that it answers, whose sign is missing; None: nothing."""
    if name == "velocity_rad_s" and (unsigned := no_sign_of_speed(capture)):
        return unsigned
    if name == "current_A" and (unsigned := no_sign_of_current(capture)):
        return unsigned
    return no_sign_of_voltage(capture) if takes_no_power(capture, name) else None


def _against(name: str, capture: Capture) -> str:
    """What is said of a channel that counts against its effort."""
    if (voltage := turned_voltage(capture)) is not None:
        return voltage
    if name == "current_A" and closes_as_it_stands(capture):
        return (
            "v = R i + K ω closes, and the motor gives power away: something else drives the shaft, of which no column "
            "tells. mend: above the header the lines  # voltage: instant  # current: instant : then R, K and L come "
            "from the winding alone"
        )
    driven = " or something else drives the shaft (a generator)" if may_be_driven(capture, name) else ""
    return f"its sign is turned{driven}. {mend(capture, name, {'scale': -1.0})} turns it"


def drift_note(drift: Drift, fit: OutputErrorFit, *, linear: bool) -> str:
    """What short free runs say where a long one was biased."""

    def told(name: str) -> str:
        before, after = drift.biased[name]
        unit = shown_unit(fit.parameters[name].unit, linear=linear)
        return f"{name} = {after:.4g} {unit} ({'not seen' if before is None else f'{before:.4g}'} here)"

    return (
        f"{100 * drift.share:.0f} % of what the free run leaves of {shown_column(drift.channel, linear=linear)} is "
        f"drift: something small that the model lacks adds up, and the parameters were biased by it. Free runs of "
        f"{SEGMENT_S:g} s give {', '.join(told(name) for name in drift.biased)}: use `--segment {SEGMENT_S:g}`, or add "
        "the `--effect` that is missing"
    )


def _held_voltage(fit: OutputErrorFit) -> tuple[str, str]:
    """What share of J a held voltage hides at most, h K²/(2 R J) (see `input_error.py`), and what to give for it to be
    in the standard deviation: in words, since R is not known, and K and J perhaps not either."""
    K, J = (fit.parameters[name] for name in ("K", "J"))
    half_s = 0.5 * fit.problem.sample_period_s
    if K.value is None or J.value is None or J.std is None:
        return f"{1e3 * half_s:.3g} ms over the mechanical time constant R J/K²", "K=…,R=…"
    return f"{100 * half_s * K.value**2 / J.value:.2g} % over R in Ω", "R=…"
