"""The paper's three methods on one capture: parameters, the 50° test, held-out error, time."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from servo_daemon.captures import Capture
from servo_daemon.errors import ServoDaemonError
from servo_daemon.identification.inverse_dynamics.estimate import Estimate
from servo_daemon.identification.output_error import FitOptions, Recording, fit_output_error
from servo_daemon.identification.output_error.problem.score import Score, score
from servo_daemon.identification.paper.coefficients import compare_coefficients, quadratic_roots
from servo_daemon.identification.paper.learned import ModelFor, learned_method
from servo_daemon.identification.paper.paper import paper_product
from servo_daemon.identification.paper.position_experiment import PositionTest, position_test
from servo_daemon.identification.paper.process_model import fit_process_model
from servo_daemon.identification.procedure.validate import natural_values
from servo_daemon.kalman.gaussian import coordinates_of
from servo_daemon.learning.examples.drawing import TrainingSpec
from servo_daemon.learning.model.model import LearnedModel
from servo_daemon.parameters import LINEAR, MOTOR_NAMES
from servo_daemon.plant.build import build_plant
from servo_daemon.plant.servo_loop import suitable_gains
from servo_daemon.samples import SampleBlock

#: The last part of the capture is only scored.
HELD_OUT = 0.3
NAMES = MOTOR_NAMES
#: L/R of a motor whose method does not tell L, s: too fast to show anywhere.
_NO_WINDING_S = 1e-6


@dataclass(frozen=True, slots=True)
class MethodResult:
    """One row of the table.

    Attributes:
        key, title: for programs and for readers.
        parameters: what the method found; empty where it could not.
        reason: why there is no result; empty where there is one.
        heldout: free runs over the last part of the capture, None without all it needs.
        position: the 50° test.
        errors: relative error of each parameter whose truth is known.
        notes: of the method.
        seconds: time taken.
    """

    key: str
    title: str
    parameters: Mapping[str, Estimate]
    reason: str = ""
    heldout: Score | None = None
    position: PositionTest | None = None
    errors: Mapping[str, float] | None = None
    notes: tuple[str, ...] = ()
    seconds: float = 0.0


@dataclass(frozen=True, slots=True)
class Comparison:
    """All methods on one capture.

    Attributes:
        assumed_R: what method 1 takes for R, Ω.
        product_V_rad: k_io·k_s of the 50° test.
        product_source: where that comes from.
        reference: the curve that distances are measured to: "truth", or the key of a method.
        truth: the true values, where the capture gives them.
    """

    capture: Capture
    methods: tuple[MethodResult, ...]
    assumed_R: float
    product_V_rad: float
    product_source: str
    reference: str
    reference_test: PositionTest | None
    truth: Mapping[str, float]


def compare_methods(
    capture: Capture,
    *,
    assumed_R: float,
    effects: tuple[str, ...],
    options: FitOptions,
    model_for: ModelFor | None,
) -> Comparison:
    """Run every method on the first part of the capture, score on the rest.

    The 50° test has the paper's k_io·k_s, lowered where the reference motor is not stable with it.

    Args:
        model_for: trains or finds the model of method 3; None: the row says that it was left out.
    """
    block = capture.block()
    cut = round((1.0 - HELD_OUT) * len(block))
    first, rest = block.slice(0, cut), block.slice(cut, len(block))
    rows = [
        _timed("method1_paper", "1 as printed", lambda: _as_printed(first, assumed_R)),
        _timed("method1", "1 corrected", lambda: _corrected(first, assumed_R)),
        _timed("method2", "2 output error", lambda: _output_error(first, effects, options)),
        _learned(capture, first, effects, options.nominal, model_for),
    ]
    truth = _truth(capture)
    rows = [_scored(row, rest, effects) for row in rows]
    reference, values = _reference(truth, rows)
    test, product, source = None, paper_product(), "the paper's 45° with method 1"
    if values is not None:
        product, source = _usable_product(values, product, capture)
        test = position_test(values, product)
        rows = [_positioned(row, product, test) for row in rows]
    rows = [replace(row, errors=_errors(row, truth)) for row in rows]
    return Comparison(capture, tuple(rows), assumed_R, product, source, reference, test, truth)


_Found = tuple[dict[str, Estimate], tuple[str, ...]]


def _learned(
    capture: Capture,
    block: SampleBlock,
    effects: tuple[str, ...],
    nominal: Mapping[str, float],
    model_for: ModelFor | None,
) -> MethodResult:
    key, title = "method3", "3 RF + GRNN"
    if model_for is None:
        return MethodResult(key, title, {}, reason="left out (--motors 0)")
    trained_s = 0.0

    def timed_model_for(spec: TrainingSpec) -> tuple[LearnedModel, str]:
        nonlocal trained_s
        began = time.perf_counter()
        found = model_for(spec)
        trained_s = time.perf_counter() - began
        return found

    counts = capture.metadata_number("counts_per_rev")
    row = _timed(
        key,
        title,
        lambda: learned_method(
            block, effects=effects, nominal=nominal, counts_per_rev=counts, model_for=timed_model_for
        ),
    )
    return replace(row, seconds=row.seconds - trained_s)  # the remark tells what the training took


def _timed(key: str, title: str, method: Callable[[], _Found]) -> MethodResult:
    """The method's row; an error of its own is a row without a result."""
    began = time.perf_counter()
    try:
        found, notes = method()
    except ServoDaemonError as error:
        return MethodResult(key, title, {}, reason=str(error), seconds=time.perf_counter() - began)
    return MethodResult(key, title, found, notes=notes, seconds=time.perf_counter() - began)


def _as_printed(block: SampleBlock, R: float) -> _Found:
    """The paper's formulas on the capture's own process model: K = k, 1 = D R + k²."""
    process = fit_process_model([block])
    k = process.gain
    D = (1.0 - k**2) / R
    if D <= 0.0:
        text = f"the paper's normalisation 1 = D R + k² leaves no positive D for the gain k = {k:.4g} of this motor"
        return _nothing(text)
    root, _ = quadratic_roots(process.sum_s, process.product_s2, R, D, 1.0)
    units = {p.name: p.unit for p in LINEAR}
    values = {"R": R, "L": root.L, "K": k, "J": root.J, "B": D}
    found = {name: Estimate(v, float("nan"), units[name]) for name, v in values.items()}
    return found, ("K is the process gain and R an assumption: both are inputs of the method",)


def _nothing(text: str) -> _Found:
    raise ServoDaemonError(text)


def _corrected(block: SampleBlock, R: float) -> _Found:
    found = compare_coefficients([block], R)
    return dict(found.parameters), found.notes


def _output_error(block: SampleBlock, effects: tuple[str, ...], options: FitOptions) -> _Found:
    fit = fit_output_error([Recording("capture", block)], effects, options)
    simulated = natural_values(fit)
    found = {
        name: Estimate(simulated[name], float("nan") if p.std is None else p.std, p.unit)
        for name, p in fit.parameters.items()
        if p.status != "undetermined"
    }
    lost = ", ".join(name for name, p in fit.parameters.items() if p.status == "undetermined")
    notes = [f"not determined by these data: {lost}"] if lost else []
    notes += [f"{c.expression} = {c.value:.5g} ± {c.std:.2g} {c.unit}" for c in fit.combinations]
    return found, tuple(notes)


def _linear_values(row: MethodResult) -> dict[str, float] | None:
    """R, L, K, J, B of a row; a winding without L is taken as too fast to matter. None where one is missing."""
    values = {n: row.parameters[n].value for n in NAMES if n in row.parameters}
    if "R" in values and "L" not in values:
        values["L"] = _NO_WINDING_S * values["R"]
    return values if len(values) == len(NAMES) and all(v > 0 for v in values.values()) else None


def _scored(row: MethodResult, rest: SampleBlock, effects: tuple[str, ...]) -> MethodResult:
    values = _linear_values(row)
    if values is None or rest.voltage_V is None or len(rest) < 2:
        return row
    own = effects if all(n in row.parameters for n in build_plant(effects).parameter_names) else ()
    plant = build_plant(own)
    values |= {n: row.parameters[n].value for n in plant.parameter_names if n in row.parameters}
    return replace(row, heldout=score(rest, plant, coordinates_of(plant.parameters, values)))


def _truth(capture: Capture) -> dict[str, float]:
    """Values at the end, else at the beginning: what ages is judged by what it has become."""
    out = {}
    for name in NAMES:
        for key in (f"truth_end_{name}", f"truth_{name}"):
            value = capture.metadata_number(key)
            if value is not None:
                out[name] = value
                break
    return out


def _reference(truth: Mapping[str, float], rows: list[MethodResult]) -> tuple[str, Mapping[str, float] | None]:
    if len(truth) == len(NAMES):
        return "truth", truth
    for row in reversed(rows):
        values = _linear_values(row)
        if values is not None:
            return row.key, values
    return "none", None


def _usable_product(values: Mapping[str, float], product: float, capture: Capture) -> tuple[float, str]:
    """The paper's gain, unless this motor is not even stable with it: then one that fits this motor."""
    if position_test(values, product).stable:
        return product, "the paper's 45° with method 1"
    gains = suitable_gains(values, 24.0, 1.0 / capture.sample_period_s)
    usable = min(gains.k_io * gains.k_s, product)
    while not position_test(values, usable).stable:
        usable /= 2.0
    return usable, f"lowered: with the paper's {product:.4g} V/rad this motor is not stable"


def _positioned(row: MethodResult, product: float, reference: PositionTest) -> MethodResult:
    values = _linear_values(row)
    return row if values is None else replace(row, position=position_test(values, product, reference))


def _errors(row: MethodResult, truth: Mapping[str, float]) -> dict[str, float]:
    return {n: row.parameters[n].value / truth[n] - 1.0 for n in NAMES if n in row.parameters and n in truth}
