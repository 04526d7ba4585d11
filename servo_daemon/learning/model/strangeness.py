"""The name that kept model files of earlier versions give to `Novelty`; nothing else imports it."""

from servo_daemon.learning.model.novelty import Novelty as Strangeness

__all__ = ["Strangeness"]
