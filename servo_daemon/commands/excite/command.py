"""`servo-daemon excite`: the motion that determines parameters best or tells causes apart, within the limits."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from servo_daemon.commands.shared import common
from servo_daemon.commands.shared.numbers import positive
from servo_daemon.errors import BadInputError

if TYPE_CHECKING:
    from servo_daemon.config import DriveConfig
    from servo_daemon.experiment import Request, Sensors, ServoGains

HELP = "plan the motion that says most: determine weak parameters, or tell two causes apart, within the limits"
EXAMPLE = """  servo-daemon excite --config servo-daemon.toml --out plan.csv --for L B
  servo-daemon excite --config servo-daemon.toml --out plan.csv --between coulomb_friction stribeck_friction
  servo-daemon excite --config servo-daemon.toml --out plan.csv --diagnosis report/diagnosis.json --seconds 30"""

#: What is assumed of sensors where nobody says it: counts a turn; current noise as a share of its limit; unseen noise
#: of the voltage as a share of its limit.
_COUNTS, _CURRENT_SHARE, _INPUT_SHARE = 4096.0, 0.002, 0.001


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_config(parser, required=True)
    common.add_out(parser, "the plan, .csv or .csv.gz", required=True)
    asked = parser.add_mutually_exclusive_group()
    asked.add_argument(
        "--for", nargs="+", default=[], dest="wanted", metavar="P", help="determine these (default: all)"
    )
    asked.add_argument(
        "--between",
        nargs="+",
        default=[],
        metavar="EFFECT",
        help="tell these effects apart ('none': no effect at all; `fit --effect help` lists them)",
    )
    asked.add_argument(
        "--diagnosis", type=Path, metavar="JSON", help="tell apart what this diagnosis.json could not; its values count"
    )
    parser.add_argument(
        "--reference",
        choices=("voltage", "velocity", "position"),
        default="voltage",
        help="what the drive takes: a voltage, or what its servo is to follow (default: voltage)",
    )
    parser.add_argument("--seconds", type=positive, default=20.0, help="length (default: 20)")
    parser.add_argument("--rate", type=positive, default=1000.0, metavar="HZ", help="samples a second (default: 1000)")
    parser.add_argument("--seed", type=int, default=0, help="same seed, same plan (default: 0)")
    common.add_fix(parser, "values that are known, as [drive.nominal] has them; repeatable")
    parser.add_argument(
        "--rms-current", type=positive, metavar="A", help="greatest RMS current (default: half of current_A)"
    )
    parser.add_argument("--current-noise", type=float, metavar="A", help="of the sensor, 1 σ; 0: there is no sensor")
    common.add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    from servo_daemon.commands.excite.output import check_path, document, text, write
    from servo_daemon.experiment import plan_motion

    check_path(arguments.out)
    common.keep_inputs(arguments.out, arguments.config, arguments.diagnosis)
    common.may_overwrite(arguments.force, arguments.out)
    drive = common.offline_drive(arguments)
    request, notes = make_request(drive, arguments)
    for line in notes:
        common.note(line)
    with common.progress(1.0, "", "planning") as bar:
        plan = plan_motion(request, lambda share, step: _advance(bar, share, step))
    report = document(drive.name, arguments.out, request, plan, notes)
    write(arguments.out, plan, report, shlex.join(["servo-daemon", *sys.argv[1:]]))
    if arguments.json:
        common.print_json(report)
    else:
        print(text(report))
    return 0


def _advance(bar: object, share: float, step: str) -> None:
    bar.set_description(step)  # type: ignore[attr-defined]
    bar.update(share - bar.n)  # type: ignore[attr-defined]


def make_request(drive: DriveConfig, arguments: argparse.Namespace) -> tuple[Request, tuple[str, ...]]:
    """The request, and what was assumed for it.

    Raises:
        BadInputError: an argument or the config is impossible or lacks something; one line naming it.
    """
    from servo_daemon.commands.excite.diagnosis import read_tied
    from servo_daemon.experiment import Request, complete_limits
    from servo_daemon.experiment.models import check_motor

    _check(arguments)
    model, between, notes = drive.model, tuple(arguments.between), list[str]()
    known = {k: v for k, v in drive.nominal.items() if k != "J_m"}
    if arguments.diagnosis is not None:
        tied = read_tied(arguments.diagnosis, drive.model)
        model, between, notes = tied.model, tied.between, list(tied.notes)
        known |= tied.values
    fixed = common.parse_fix(",".join(arguments.fix))
    known |= fixed
    check_motor(known)
    given = {k: getattr(drive.limits, k) for k in ("voltage_V", "current_A", "velocity_rad_s", "travel_rad")}
    limits, assumed = complete_limits(known, **given, current_rms_A=arguments.rms_current)
    sensors, more = _sensors(drive, arguments, limits.voltage_V, limits.current_A)
    gains, loop = _gains(drive, known, arguments)
    request = Request(
        known=known,
        fixed=tuple(fixed),
        model=tuple(model),
        wanted=tuple(arguments.wanted),
        between=between,
        limits=limits,
        sensors=sensors,
        reference=arguments.reference,
        gains=gains,
        seconds=arguments.seconds,
        rate_hz=arguments.rate,
        seed=arguments.seed,
    )
    return request, (*notes, *assumed, *more, *loop)


def _check(arguments: argparse.Namespace) -> None:
    """That the numbers make sense.

    Raises:
        BadInputError: one does not.
    """
    if arguments.seed < 0:
        raise BadInputError(f"--seed must not be negative, not {arguments.seed}")


def _sensors(
    drive: DriveConfig, arguments: argparse.Namespace, voltage_V: float, current_A: float
) -> tuple[Sensors, tuple[str, ...]]:
    """What the drive measures with, and what of it was assumed."""
    from servo_daemon.experiment import Sensors

    notes, counts, noise = [], drive.load.counts_per_rev, arguments.current_noise
    if counts is None:
        counts = _COUNTS
        notes.append(f"no counts_per_rev in [drive.load]: {counts:g} counts a turn")
    if noise is None:
        noise = _CURRENT_SHARE * current_A
        notes.append(f"current noise: {noise:.3g} A, {100 * _CURRENT_SHARE:g} % of current_A (--current-noise sets it)")
    elif not 0 <= noise < float("inf"):
        raise BadInputError(f"--current-noise must not be negative, not {noise:g}")
    return Sensors(counts, noise or None, _INPUT_SHARE * voltage_V), tuple(notes)


def _gains(
    drive: DriveConfig, known: Mapping[str, float], arguments: argparse.Namespace
) -> tuple[ServoGains | None, tuple[str, ...]]:
    """Of the servo that follows a speed or an angle: the configured ones, and what was taken for those that are not."""
    from servo_daemon.experiment import suitable_gains

    if arguments.reference == "voltage":
        return None, ()
    gains, notes = suitable_gains(known, arguments.rate), []
    names = ("speed_kp_V_s_rad", "speed_ki_V_rad", "position_kp_1_s")
    for name in names if arguments.reference == "position" else names[:2]:
        value = getattr(drive.controller, name)
        if value is None:
            notes.append(f"no {name} in [drive.controller]: {getattr(gains, name):.4g}")
        else:
            gains = replace(gains, **{name: value})
    return gains, tuple(notes)
