"""Method 2 of the paper, done with care: output-error estimation of a motor from recordings.

    from servo_daemon.identification.output_error import Recording, fit_output_error
    fit = fit_output_error([Recording("a.csv", block)], effects=("coulomb_friction",))
    fit.parameters["R"].value, fit.parameters["R"].std

The motor is simulated freely from the recorded input and compared with what was measured; the parameters (and each
segment's initial state) that leave least are found by a bounded Gauss–Newton method on exact sensitivities. What the
recording cannot determine is said, not guessed.
"""

from servo_daemon.identification.output_error.fit import fit_output_error
from servo_daemon.identification.output_error.fitted import FitOptions, OutputErrorFit
from servo_daemon.identification.output_error.precision.parameters import FittedParameter
from servo_daemon.identification.output_error.problem.setup import Recording

__all__ = ["FitOptions", "FittedParameter", "OutputErrorFit", "Recording", "fit_output_error"]
