"""A model trained beside a running daemon: in a process of its own, at low priority, on one core."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
from multiprocessing.connection import Connection
from pathlib import Path

from servo_daemon.errors import BadInputError
from servo_daemon.learning import Learner
from servo_daemon.learning.examples.drawing import TrainingSpec
from servo_daemon.learning.model.cache import cached_model, model_path
from servo_daemon.learning.model.model import LearnedModel


class BackgroundTraining:
    """Trains unless a model is kept already. The caller polls; nothing here blocks but `stop`.

    Args:
        spec, motors: what is to be trained.
        nice: added to the priority: whoever else wants the core comes first.
        learner: see `learners`.

    Attributes:
        done: motors simulated so far.
        error: why there will be no model; "" while all is well.
    """

    def __init__(self, spec: TrainingSpec, motors: int, nice: int = 15, learner: Learner = "grnn") -> None:
        self.spec, self.motors = spec, motors
        self.done, self.error = 0, ""
        self._learner = learner
        self._model = cached_model(spec, motors, learner)
        self._process: multiprocessing.process.BaseProcess | None = None
        if self._model is None:
            # A fresh process: a forked one would inherit the daemon's sockets, locks and threads' halves of work.
            context = multiprocessing.get_context("spawn")
            self._receiver, sender = context.Pipe(duplex=False)
            self._process = context.Process(
                target=_work, args=(spec, motors, nice, learner, sender), daemon=True, name="training"
            )
            self._process.start()
            sender.close()

    @property
    def running(self) -> bool:
        """Whether a model may still come."""
        return self._process is not None

    def model(self) -> LearnedModel | None:
        """The model once it is there; until then, and where there is none to come, None."""
        if self._process is None:
            return self._model
        try:
            while self._process is not None and self._receiver.poll():
                self._take(self._receiver.recv())
        except (EOFError, OSError):
            self._end("the training process ended without a model")
        return self._model

    def _take(self, message: int | str) -> None:
        if isinstance(message, int):
            self.done = message
            return
        self._model = cached_model(self.spec, self.motors, self._learner) if not message else None
        self._end(message or ("" if self._model is not None else "the trained model could not be kept"))

    def _end(self, error: str) -> None:
        assert self._process is not None
        self.error = error
        self._receiver.close()
        self._process.join(timeout=5.0)
        self._process = None

    def stop(self) -> None:
        """Ends the process if it is still at work."""
        if self._process is None:
            return
        self._process.terminate()
        self._end("stopped")


def _work(spec: TrainingSpec, motors: int, nice: int, learner: Learner, sender: Connection) -> None:
    """In the process: train, keep, and tell "" or what went wrong."""
    from servo_daemon.learning.model.model_file import save_model
    from servo_daemon.learning.training.run import Job, train

    with contextlib.suppress(OSError):
        os.nice(nice)
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"
    try:
        model = train(spec, Job(motors, learner=learner, jobs=1), progress=sender.send)
        path: Path = model_path(spec)
        save_model(model, path)
    except BadInputError as error:
        sender.send(str(error))
    else:
        sender.send("")
