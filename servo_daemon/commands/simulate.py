"""`servo-daemon simulate`: writes a capture of a simulated motor."""

from __future__ import annotations

import argparse
import shlex
import sys

from servo_daemon.commands.shared import common
from servo_daemon.commands.shared.effect_flag import add_effect
from servo_daemon.errors import BadInputError

HELP = "write a capture of a simulated motor (the paper's, unless told otherwise)"
EXAMPLE = """  servo-daemon simulate --out aged.csv.gz --seconds 60 --ageing R=+40% K=-15%
  servo-daemon simulate --out rub.csv --effect coulomb_friction:Tc=0.3 --seed 7"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_out(parser, ".csv, .csv.gz or .parquet", required=True)
    add_effect(parser, "an effect the motor has")
    parser.add_argument("--seconds", type=float, default=60.0, help="length (default: 60)")
    parser.add_argument("--rate", type=float, default=1000.0, metavar="HZ", help="samples a second (default: 1000)")
    parser.add_argument("--seed", type=int, default=0, help="same seed, same capture (default: 0)")
    parser.add_argument(
        "--ageing",
        nargs="+",
        action="extend",
        default=[],
        metavar="P=±%",
        help="R=+40%% (over the whole capture), R=+40%%/300s[:exp], R=+30%%@12s, K=5%%/sqrt(min):walk, J_d=+0.003@10s",
    )
    parser.add_argument(
        "--motor", default="", metavar="P=v,…", help="other values of R, L, K, J, B, e.g. R=2.1,L=1e-3 (SI units)"
    )
    parser.add_argument("--motion", choices=("mixed", "steps", "speed", "rest"), default="mixed", help="what it does")
    parser.add_argument("--supply", type=float, default=24.0, metavar="V", help="supply voltage (default: 24)")
    common.add_json(parser)


def _assignments(text: str) -> dict[str, float]:
    """'R=2.1,L=1e-3' as numbers.

    Raises:
        BadInputError: not of that form.
    """
    values = {}
    for part in filter(None, (p.strip() for p in text.split(","))):
        name, _, value = part.partition("=")
        try:
            values[name.strip()] = float(value)
        except ValueError:
            raise BadInputError(f"--motor: {part!r} is not of the form R=2.1") from None
    return values


def run(arguments: argparse.Namespace) -> int:
    from servo_daemon.captures import write_capture
    from servo_daemon.captures.capture.model import MIN_SAMPLES
    from servo_daemon.simulate import simulate_capture

    common.may_overwrite(arguments.force, arguments.out)
    ageing = [part for text in arguments.ageing for part in text.split(",") if part]
    block, metadata = simulate_capture(
        effects=arguments.effect,
        seconds=arguments.seconds,
        rate_hz=arguments.rate,
        seed=arguments.seed,
        ageing=ageing,
        motor=_assignments(arguments.motor) or None,
        motion=arguments.motion,
        supply_V=arguments.supply,
        command=shlex.join(["servo-daemon", *sys.argv[1:]]),
    )
    if len(block) < MIN_SAMPLES:
        few = f"{arguments.seconds:g} s at {arguments.rate:g} Hz are {len(block)} sample"
        raise BadInputError(f"{few}: a capture has at least {MIN_SAMPLES}")
    write_capture(arguments.out, block, metadata=metadata)
    if arguments.json:
        common.print_json({"capture": str(arguments.out), "samples": len(block), "metadata": metadata})
    else:
        common.note(f"{arguments.out}: {len(block):,} samples, {arguments.seconds:g} s at {arguments.rate:g} Hz")
    return 0
