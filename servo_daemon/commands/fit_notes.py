"""What a fit's numbers say about the data they came from, in sentences for the user."""

from __future__ import annotations

from collections.abc import Mapping

from servo_daemon.estimators.output_error import OutputErrorFit

#: An estimate further from its nominal value than this factor is no ageing: a unit, a sign, another motor.
_FAR = 10.0
#: A residual of this share of the signal's spread is no simulation of it.
_NOTHING = 0.7


def result_notes(fit: OutputErrorFit, nominal: Mapping[str, float]) -> list[str]:
    """Remarks on estimates far from their nominal values, at a bound, and on how the input is taken."""
    notes = []
    for name, p in fit.parameters.items():
        given = nominal.get(name)
        if p.status != "estimated" or p.value is None:
            continue
        if given is not None and given > 0 and p.value > 0 and not 1 / _FAR < p.value / given < _FAR:
            notes.append(
                f"{name} = {p.value:.4g} {p.unit} is {p.value / given:.3g} times its nominal value: "
                "is a column in another unit, or its sign turned?"
            )
        if p.at_bound:
            notes.append(f"{name} ended at its physical bound, {p.value:.3g} {p.unit}: the data ask for what cannot be")
    for name, spread in zip(fit.problem.channels, fit.problem.spread, strict=True):
        if fit.residual[name].rmse > _NOTHING * spread > 0:
            notes.append(f"the model explains next to nothing of {name}: is its sign turned, or its unit wrong?")
    if fit.problem.plant.drive != "voltage":
        what = "current" if fit.problem.plant.drive == "current" else "torque"
        notes.append(
            f"the {what} is known at the samples and taken as straight between them: what it does in between is in "
            "none of the standard deviations"
        )
    return notes
