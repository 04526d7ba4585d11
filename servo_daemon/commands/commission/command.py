"""`servo-daemon commission`: moves the motor, small first, until its parameters are known, and stops on any doubt."""

from __future__ import annotations

import argparse
import re
from dataclasses import replace
from typing import TYPE_CHECKING

from servo_daemon.commands.shared import common
from servo_daemon.errors import BadInputError, RefusedError, ServoDaemonError

if TYPE_CHECKING:
    from drivers.base import Driver
    from drivers.commanding import Commanding
    from servo_daemon.captures import Capture
    from servo_daemon.commissioning import Commissioning, MotionLimits
    from servo_daemon.config import DriveConfig
    from servo_daemon.diagnosis.verdict.result import Diagnosis

HELP = "move the motor, small first and within limits, until its parameters are known; stops on any doubt"
EXAMPLE = """  servo-daemon commission --config servo-daemon.toml --drive axis1 --out axis1/
  servo-daemon commission --config servo-daemon.toml --accuracy 0.5% --out axis1/ --json"""

#: Processor time of the diagnosis where something is unexplained, s.
_BUDGET_S = 300.0
_PERCENT = re.compile(r"(\d+\.?\d*|\.\d+) ?%")
#: Stops after which the samples are the motor's own, and a diagnosis may name what the model lacks.
_UNEXPLAINED = ("innovations", "hard_stop")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_config(parser, required=True)
    common.add_out(parser, "capture, commission.json, commission.toml, tuning.json … go there", metavar="DIR")
    parser.add_argument(
        "--accuracy", default="1%", metavar="1%", help="1 σ of every parameter, as a share of its value (default: 1%%)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the motion (default: 0)")
    parser.add_argument(
        "--budget", type=float, default=_BUDGET_S, metavar="SECONDS",
        help="of processor time for a diagnosis of what is unexplained; 0: none (default: 300)",
    )  # fmt: skip
    common.add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    from servo_daemon.commands.commission import output
    from servo_daemon.commissioning import Ask, commission

    if arguments.seed < 0 or not 0.0 <= arguments.budget < float("inf"):
        raise BadInputError("--seed and --budget must not be negative")
    accuracy = parse_accuracy(arguments.accuracy)
    drive = common.offline_drive(arguments)
    limits = motion_limits(drive)
    output.prepare(arguments.out, arguments.force)
    ask = Ask(accuracy, drive.model, arguments.seed)
    driver, commands = commanding_driver(drive)
    bar = common.progress(limits.seconds, "s", "commission")

    def told(seconds: float, step: str) -> None:
        bar.set_description(step)
        bar.update(seconds - bar.n)

    with bar, common.stop_requested() as stop, driver:
        result = commission(commands, limits, ask, stop.is_set, told)
    capture = output.capture_of(drive, driver.info, result)
    diagnosis = None
    if arguments.budget and _is_unexplained(result):
        common.note("the model does not explain the samples: looking for what it lacks")
        diagnosis = _diagnosed(capture, drive, arguments.budget)
        result = _with_found(result, diagnosis, accuracy)
    tuning = output.tuned(drive, driver.info, result, diagnosis)
    document = output.document(drive, limits, ask, result, diagnosis, tuning)
    if arguments.out is not None:
        output.write(arguments.out, capture, document, tuning)
    if arguments.json:
        common.print_json(document)
    else:
        print(output.text(document, tuning))
    return 0 if result.stop is None else 130 if result.stop.reason == "interrupted" else 1


def parse_accuracy(text: str) -> float:
    """'1%' as 0.01.

    Raises:
        BadInputError: not of that form, or not between 0 and 50 %.
    """
    match = _PERCENT.fullmatch(text.strip())
    share = float(match[1]) / 100.0 if match else 0.0
    if not 0.0 < share <= 0.5:
        raise BadInputError(f"--accuracy must be a share between 0 and 50 % such as 1%, not {text!r}")
    return share


def motion_limits(drive: DriveConfig) -> MotionLimits:
    """What the configuration allows.

    Raises:
        RefusedError: no motion.
    """
    from servo_daemon.commissioning import MotionLimits

    c = drive.commission
    if not c.allow_motion or None in (c.voltage_V, c.current_A, c.speed_rad_s, c.travel_rad):
        raise RefusedError(
            f"drive {drive.name}: commissioning moves the motor, and the configuration does not allow it: "
            "[drive.commission] needs allow_motion = true and the limits voltage_V, current_A, speed_rad_s, travel_rad"
        )
    values = c.model_dump(exclude={"allow_motion"})
    return MotionLimits(**values)


def commanding_driver(drive: DriveConfig) -> tuple[Driver, Commanding]:
    """The drive's driver, closed, by both of its sides.

    Raises:
        RefusedError: it cannot command.
    """
    from drivers.commanding import make_commanding

    made = make_commanding(drive.driver, drive.name, drive.options)
    if made is None:
        raise RefusedError(
            f'drive {drive.name}: driver = "{drive.driver}" only reads; `servo-daemon excite` plans a motion for the '
            "drive's own tool to play, and `servo-daemon fit` takes its record"
        )
    return made


def _is_unexplained(result: Commissioning) -> bool:
    if result.stop is None:
        return result.outcome == "unexplained"
    if result.stop.reason == "hard_stop" and (result.fit is None or "J" not in result.fit.values):
        return False  # it stands in the way from the beginning: the samples are the stop's
    return result.stop.reason in _UNEXPLAINED


def _diagnosed(capture: Capture, drive: DriveConfig, budget_s: float) -> Diagnosis | None:
    from servo_daemon.commands.diagnose.progress import progress_told
    from servo_daemon.diagnosis.diagnose import DiagnoseOptions, diagnose

    try:
        with progress_told(as_json=False) as told:
            return diagnose([capture], (), DiagnoseOptions(drive.model, budget_s=budget_s), told)
    except ServoDaemonError as error:
        common.note(f"no diagnosis: {error}")
        return None


def _with_found(result: Commissioning, diagnosis: Diagnosis | None, accuracy: float) -> Commissioning:
    """The values of the extended model, where a cause was found: with it all may be known."""
    from servo_daemon.commissioning import unknown_in

    if diagnosis is None or diagnosis.extended is None:
        return result
    unknown = unknown_in(diagnosis.extended, accuracy)
    outcome = "known" if result.stop is None and not unknown else result.outcome
    return replace(result, outcome=outcome, fit=diagnosis.extended, unknown=unknown)
