"""Parameters from predictions of each sample by those before it."""

from servo_daemon.identification.prediction_error.refine import predicted_fit

__all__ = ["predicted_fit"]
