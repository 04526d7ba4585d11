"""`servo-daemon train`: the paper's third method for this drive, learned from simulated motors around its datasheet."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servo_daemon.commands.shared import common
from servo_daemon.commands.shared.numbers import positive
from servo_daemon.learning import DEFAULT_MOTORS

if TYPE_CHECKING:
    from servo_daemon.config import DriveConfig
    from servo_daemon.learning.examples.drawing import TrainingSpec
    from servo_daemon.learning.examples.training import TrainingSet
    from servo_daemon.learning.model.model import LearnedModel
    from servo_daemon.learning.training.run import Job

HELP = "train the paper's third method (random forest, GRNN) on simulated motors around the drive's datasheet"
EXAMPLE = """  servo-daemon train --config servo-daemon.toml
  servo-daemon train --config servo-daemon.toml --motors 20000 --dask tcp://cluster:8786"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--motors", type=int, default=DEFAULT_MOTORS, metavar="N", help=f"how many to simulate ({DEFAULT_MOTORS})"
    )
    parser.add_argument("--dask", metavar="ADDRESS", help="simulate on a Dask cluster, e.g. tcp://host:8786")
    parser.add_argument("--jobs", type=int, default=-1, metavar="N", help="processes here (default: one per core)")
    parser.add_argument(
        "--rate", type=positive, metavar="HZ", help="the drive's sample rate (the simulated driver's own, else 1000)"
    )
    parser.add_argument(
        "--window", type=float, metavar="S", help="window of operation, 2–10 s (the config's refresh_window_s, else 5)"
    )
    parser.add_argument("--spread", type=float, default=3.0, metavar="F", help="nominal/F … nominal·F is trained (3)")
    parser.add_argument("--learner", default="grnn", help="grnn (default), boosting, forest, ridge, neighbours")
    parser.add_argument(
        "--measured",
        type=Path,
        action="append",
        default=[],
        metavar="CAPTURE",
        help="a capture of a motor whose metadata say truth_R … truth_B, learned beside the simulated ones; repeatable",
    )
    parser.add_argument("--seed", type=int, default=0, help="same seed, same model (default: 0)")
    common.add_out(parser, "where to write the model (default: where `run` looks, in place of the one before)")
    common.add_signals(parser, rate=False)
    common.add_config(parser)
    common.add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    from servo_daemon.errors import BadInputError
    from servo_daemon.learning import LEARNERS
    from servo_daemon.learning.model.cache import model_path
    from servo_daemon.learning.model.model_file import save_model
    from servo_daemon.learning.training.run import Job

    if arguments.learner not in LEARNERS:
        raise BadInputError(f"--learner: {arguments.learner!r} is none of {', '.join(LEARNERS)}")
    _check_numbers(arguments)
    drive = common.offline_drive(arguments)
    spec = drive_spec(
        drive,
        configured=arguments.config is not None,
        rate_hz=arguments.rate,
        spread=arguments.spread,
        window_s=arguments.window,
        seed=arguments.seed,
    )
    path = arguments.out or model_path(spec)
    _check_out(arguments, path)
    measured = _measured(arguments.measured, arguments, spec.window_s) if arguments.measured else None
    job = Job(arguments.motors, learner=arguments.learner, jobs=arguments.jobs, dask=arguments.dask, measured=measured)
    model = train_with_bar(spec, job)
    save_model(model, path)
    document = model_document(model, path)
    common.answer(arguments, document, _print)
    return 0


def _check_numbers(arguments: argparse.Namespace) -> None:
    """What the libraries below would refuse in words of their own.

    Raises:
        BadInputError: naming the flag.
    """
    from servo_daemon.errors import BadInputError

    if arguments.motors < 1:
        raise BadInputError(f"--motors must be at least 1, not {arguments.motors}")
    if arguments.jobs == 0:
        raise BadInputError("--jobs must not be 0 (-1: one per core)")
    if arguments.seed < 0:
        raise BadInputError(f"--seed must not be negative, not {arguments.seed}")


def _check_out(arguments: argparse.Namespace, path: Path) -> None:
    """What cannot be written should not be trained first.

    Raises:
        BadInputError: it cannot.
    """
    from servo_daemon.commands.shared.output_folder import OutputFolder
    from servo_daemon.errors import BadInputError

    common.keep_inputs(path, arguments.config, *arguments.measured)
    if path.is_dir():
        raise BadInputError(f"--out {path}: is a folder")
    common.may_overwrite(arguments.force or arguments.out is None, path)
    OutputFolder(path.parent).check_writable()


def drive_spec(drive: DriveConfig, *, configured: bool = True, **wanted: Any) -> TrainingSpec:
    """What to simulate for a drive of the config; see `training_spec`.

    Args:
        configured: False: there is no config, the drive is the simulated one.
    """
    from servo_daemon.pipeline.training_spec import training_spec
    from servo_daemon.simulate import DEFAULT_NOMINAL

    return training_spec(drive, nominal=None if configured else DEFAULT_NOMINAL, **wanted)


def train_with_bar(spec: TrainingSpec, job: Job) -> LearnedModel:
    """Trained, with a progress bar on stderr where somebody watches."""
    from servo_daemon.learning.training.run import train

    with common.progress(job.motors, "motor", "simulating") as bar:

        def done(motors: int) -> None:
            bar.update(motors - bar.n)

        return train(spec, job, progress=done, say=bar.set_description)


def _measured(paths: Sequence[Path], arguments: argparse.Namespace, window_s: float) -> TrainingSet:
    from servo_daemon.errors import BadInputError
    from servo_daemon.learning.examples.training import TARGETS, measured_training

    known = []
    for capture in common.read_captures(paths, arguments):
        found = {
            name: value
            for name in TARGETS
            for key in (f"truth_{name}", f"truth_end_{name}")
            if (value := capture.metadata_number(key)) is not None
        }
        meaning = capture.meaning()
        if meaning.follows_current:
            kinds = f"voltage = {meaning.voltage}, current = {meaning.current}"
            raise BadInputError(
                f"{capture.path}: {kinds}: features are those of a held voltage and a current at its rows"
            )
        try:
            known.append(measured_training([(capture.as_dc(meaning).block(), found)], window_s))
        except BadInputError as error:
            raise BadInputError(f"{capture.path}: {str(error).partition(': ')[2]}") from error
    first, *others = known
    for other in others:
        first = first.joined(other)
    return first


def model_document(model: LearnedModel, path: Path) -> dict[str, Any]:
    """What a trained model is, for `--json` and for people."""
    spec = model.spec
    return {
        "model": str(path),
        "learner": model.learner,
        "target": model.target,
        "nominal": dict(spec.nominal),
        "spread": spec.spread,
        "effects": list(spec.effects),
        "rate_hz": spec.rate_hz,
        "window_s": spec.window_s,
        **dict(model.facts),
        "feature_names": list(model.feature_names),
    }


def _print(document: dict[str, Any]) -> None:
    errors = document["median_error"]
    parts = ", ".join(f"{n} {100 * e:.2g} %" for n, e in errors.items() if n != "Tc")
    print(f"{document['model']}")
    print(
        f"  {document['motors']} of {document['motors_drawn']} simulated motors gave a usable window; "
        f"{document['features_kept']} of {document['features']} features kept "
        f"(costs {100 * document['screening_loss']:+.1f} % of the error)"
    )
    print(f"  median error on motors it has not seen: {parts}, Tc {100 * errors['Tc']:.2g} % of the torque")
    print(
        f"  accepts {100 * document['accepted']:.0f} % of their windows, "
        f"{100 * document['accepted_faulty']:.0f} % of those with a drawn fault (many are slight), "
        f"{100 * document['accepted_foreign']:.0f} % of those of motors 1.4 to 5 times outside the range"
    )
    print(f"  simulated in {document['simulation_s']:.0f} s, trained in {document['seconds']:.0f} s")
