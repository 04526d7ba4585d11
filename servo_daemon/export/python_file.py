"""`--to python`: a twin of the motor in NumPy, in one file that tests itself against what the plant makes of it."""

from __future__ import annotations

import numpy as np

from servo_daemon.export.balances import Balances, balances, expressible, rigid
from servo_daemon.export.expressions import PYTHON
from servo_daemon.export.model import Export, ExportedModel, Target
from servo_daemon.export.reference import PHASES, Run, simulated, trial_input
from servo_daemon.export.words import common_notes, header, line_comments, not_expressed, number
from servo_daemon.samples import F64

#: Substeps per time constant of the fastest part: RK4's error is then below 1e-5 of a step.
_PER_CONSTANT = 8.0
#: Samples of the self-test, and every which of them is compared.
_SAMPLES, _EVERY = 200, 20
#: Largest share of a state's range that the twin may be off: dry friction in substeps leaves some tenths of a percent.
_TOLERANCE = 0.01

_STEP = '''

def rates(t, x, u{drop}):
    """d/dt of the states without dry friction; u: {input}."""
    {unpack} = x
    return np.array([{rates}])


def smooth(t, x, u, d{drop}):
    """States after d seconds without dry friction: Runge and Kutta."""
    a = rates(t, x, u{passed})
    b = rates(t + d / 2, x + d / 2 * a, u{passed})
    c = rates(t + d / 2, x + d / 2 * b, u{passed})
    e = rates(t + d, x + d * c, u{passed})
    return x + d / 6 * (a + 2 * b + 2 * c + e)

{flow}
def dry(t, x, u, h):
    """Dry friction over h: it stops and never drives."""
    {unpack} = x
    forward, backward = {forward}, {backward}
    x[{w}] -= h / J * np.clip(omega * J / h, -backward, forward)
    return x


def step(t, x, u, h):
    """States after h seconds with the input held."""
    n = max(1, int(np.ceil(h / SUBSTEP)))
    d = h / n
    for _ in range(n):
        x = {advance}(t, dry(t, np.array(x, float), u, d / 2), u, d)
        t, x = t + d, dry(t + d, x, u, d / 2)
    return x


def sensed(t, x, u):
    """What the drive's sensors show: (current_A, velocity_rad_s, position_rad) at the encoder, as the drive reports."""
    {unpack} = x
    return np.array([{current} / I_FACTOR, {speed} / GEAR, {angle} / GEAR])


if __name__ == "__main__":  # the same motion as servo-daemon's own simulation has it
    H = {period}
    U = np.repeat({inputs}, {each})
    EXPECTED = np.array({expected})
    x, rows = np.array(X0), []
    for k, u in enumerate(U):
        x = step(k * H, x, u, H)
        if (k + 1) % {every} == 0:
            rows.append(x[: EXPECTED.shape[1]])
    worst = np.max(np.abs(np.array(rows) - EXPECTED) / np.ptp(EXPECTED, axis=0).clip(1e-12))
    print(f"self-test: at most {{100 * worst:.3g}} % of each state's range off")
    assert worst < {tolerance}, "the twin does not follow servo-daemon's simulation"
'''

#: Where a voltage opposes the current whatever its size: it stops the current and never drives it.
_FLOW = '''
def blocked(t, x, u, d):
    """The same with a voltage against the current: what would stop it, and no more than there is."""
    {unpack} = x
    most = {level}
    free, probe = smooth(t, x, u, d)[0], smooth(t, x, u, d, 1.0)[0]
    return smooth(t, x, u, d, np.clip(free / (free - probe), -most, most))

'''


def write(model: ExportedModel) -> Export:
    """Raises BadInputError: a parameter is not known."""
    model = rigid(model, "python")
    values = model.require(model.needed, "python")
    b = balances(model)
    why = dict.fromkeys(model.effects, "is more than a term in a balance, and left out of the twin")
    notes = [*common_notes(model), *not_expressed(model, [n for n in model.effects if expressible(n)], why)]
    v, i = model.meaning.factors
    constants = [f"{name} = {number(values[name])}" for name in b.used]
    constants += [f"V_FACTOR, I_FACTOR, GEAR = {v!r}, {i!r}, {model.gear!r}", f"SUBSTEP = {_substep_s(values):.6g}"]
    plain = ExportedModel(
        model.name, model.source, model.drive, tuple(n for n in model.effects if expressible(n)), model.values, {}
    )
    u, period = trial_input(model, _SAMPLES)
    run = simulated(plain, u, period)
    initial = [s.initial for s in run.plant.states]
    constants.append(f"X0 = {initial}  # {', '.join(run.plant.state_names)}")
    body = _code(model, b, u, period, run)
    head = line_comments([*header(model, notes), "python FILE runs its self-test"], "#")
    return Export(("\n".join([head, "import numpy as np", "", *constants, ""]) + body).encode(), tuple(notes))


def _code(model: ExportedModel, b: Balances, u: F64, period: float, run: Run) -> str:
    """The text of the model's functions and of the file's self-test."""
    core = ["i", "omega", "theta"] if model.drive == "voltage" else ["omega", "theta"]
    blocks, unpack = not b.dry_drop.is_zero(), ", ".join([*core, *b.states])
    against = " - drop / L" if blocks else ""
    rates = ([b.text(b.current_rate, PYTHON) + against] if model.drive == "voltage" else []) + [
        b.text(b.speed_rate, PYTHON), "omega", *(b.text(rate, PYTHON) for rate in b.states.values())
    ]  # fmt: skip
    shown = run.x[_EVERY::_EVERY, : len(core)]
    return _STEP.format(
        input=f"{model.drive} of the DC motor",
        unpack=unpack, rates=", ".join(rates), w=len(core) - 2,
        drop=", drop=0.0" if blocks else "", passed=", drop" if blocks else "",
        advance="blocked" if blocks else "smooth",
        flow=_FLOW.format(unpack=unpack, level=b.text(b.dry_drop, PYTHON)) if blocks else "",
        forward=b.text(b.forward, PYTHON), backward=b.text(b.backward, PYTHON),
        **dict(zip(("current", "speed", "angle"), b.shown(model.drive, PYTHON), strict=True)),
        period=repr(period), inputs=u[:: _SAMPLES // PHASES].tolist(), each=_SAMPLES // PHASES,
        every=_EVERY, tolerance=_TOLERANCE,
        expected=[[float(f"{x:.9g}") for x in row] for row in shown.tolist()],
    )  # fmt: skip


def _substep_s(v: dict[str, float]) -> float:
    """A share of the fastest time constant, s."""
    fastest = v["B"] / v["J"]
    if "R" in v:
        fastest = max(fastest, v["R"] / v["L"], v["K"] / float(np.sqrt(v["L"] * v["J"])))
    return 1.0 / (_PER_CONSTANT * fastest)


TARGET = Target("python", ".py", write)
