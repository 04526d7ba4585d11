"""`--to c`: the estimator for the drive's own processor, from its template and the generated step."""

from __future__ import annotations

import textwrap
from importlib.resources import files

from servo_daemon.errors import BadInputError
from servo_daemon.export.c.lines import c_lines, literal
from servo_daemon.export.c.step import KNOWN, build_step, doublings_for
from servo_daemon.export.model import ASSUMED_PERIOD_S, CORE, Export, ExportedModel, Target
from servo_daemon.export.words import common_notes, header
from servo_daemon.plant.effects import parameter_table

#: Twice the drive's own step, for a sample that was lost.
_LONGEST = 2.0
#: Measured with 4 parameters at 1 kHz by tests/unit/export/test_export_c_cortex.py (arm-none-eabi-gcc 12.2 -O3
#: -mcpu=cortex-m4 -mfpu=fpv4-sp-d16, QEMU with -icount): the step's operations, all instructions of a sample, stack.
_MEASURED_OPERATIONS, _MEASURED_INSTRUCTIONS, _MEASURED_STACK = 624, 2402, 360
_CLOCK_MHZ = 168.0


def write(model: ExportedModel) -> Export:
    """Raises BadInputError: an effect that the estimator lacks, no voltage as input, or a value is not known."""
    _refuse_strange(model)
    names = ("R", "K", "J", "B", *(KNOWN[name] for name in model.effects))
    values = model.require((*names, "L"), "c")
    notes = common_notes(model)
    period = model.sample_period_s
    if period is None:
        notes.append("the sample rate is not given (--rate-hz): made for 1 kHz")
        period = ASSUMED_PERIOD_S
    longest = _LONGEST * period
    filled = {
        "HEADER": "\n".join(["/*", *(f" * {line}" for line in header(model, notes)), " */"]),
        "LONGEST": literal(longest),
        "GEAR": "" if model.gear == 1.0 else f", times the gear of {model.gear:g}",
        "TIME": _TIME,
        **_parameters(model, names, values),
        **_step(names, values, longest),
    }
    notes.append("define SERVO_RAD_PER_COUNT and give the noise of your converters to the start: no export knows them")
    source, head = (_filled(name, filled) for name in ("servo_estimator.c", "servo_estimator.h"))
    return Export(source, tuple(notes), {"servo_estimator.h": head})


def _refuse_strange(model: ExportedModel) -> None:
    """Raises BadInputError: an effect that the estimator lacks, or no voltage as input."""
    if model.drive != "voltage":
        raise BadInputError(f"--to c needs a model with the voltage as input; this one has the {model.drive}")
    if strange := [name for name in model.effects if name not in KNOWN]:
        raise BadInputError(
            f"--to c: the estimator in C knows the linear motor, {', '.join(KNOWN)}; of a motor with "
            f"{', '.join(strange)} its estimates would be wrong and sure of themselves: let the daemon estimate it"
        )


def _parameters(model: ExportedModel, names: tuple[str, ...], values: dict[str, float]) -> dict[str, str]:
    """What the templates say of the parameters that are estimated, and of L, which is not."""
    table = parameter_table()
    return {
        "NAMES": ", ".join(f"SERVO_{name.upper()}" for name in names),
        "QUOTED": ", ".join(f'"{name}"' for name in names),
        "N": str(len(names)),
        "L": literal(values["L"]),
        "VALUES": _array([values[name] for name in names]),
        "STDS": _array([_std(model, name) for name in names]),
        "LOWEST": _array([table[name].lower for name in names]),
        "HIGHEST": _array([table[name].upper for name in names]),
        "SIGNED": ", ".join(str(int(table[name].transform != "log")) for name in names),
        "AWAY": _AWAY if "Tc" in names else "",
        "LINEAR": str(int(len(names) == len(CORE["voltage"]) - 1)),
        "MEMORY": f"{_size(len(names))} bytes (sizeof(servo_estimator)), with 4 parameters {_MEASURED_STACK} of stack.",
    }


def _step(names: tuple[str, ...], values: dict[str, float], longest: float) -> dict[str, str]:
    """What the templates hold of the generated step, for samples that are at most `longest` apart, s."""
    code = build_step(names, values["L"], doublings_for(values, longest))
    body = c_lines(code.function, ("x", "xi", "away", "p", "=u", "=h"), ("xn", "xin", "fx", "fq", "g"))
    return {
        "OPERATIONS": str(code.operations),
        "STEP": textwrap.indent("\n".join(body), "    "),
        "HELPERS": "".join(text for name, text in _HELPERS.items() if any(f"{name}(" in line for line in body)),
    }


#: Of the step's lines, where it has them: a function that is not used is a warning.
_HELPERS = {
    "servo_min": "static inline float servo_min(float a, float b) { return a < b ? a : b; }\n",
    "servo_sign": "static inline float servo_sign(float a) { return (float)((a > 0.0f) - (a < 0.0f)); }\n",
}
#: A shaft that sticks forgets its speed: see `kalman/model.py`.
_AWAY = "    away[1] += (away[1] >= 0.0f ? TO_SLIDE : -TO_SLIDE) * sqrtf(variance(e, SERVO_SPEED));"


_TIME = (
    f"{_MEASURED_INSTRUCTIONS} instructions a sample on a Cortex-M4F (-O3) with 4 parameters at 1 kHz, where the step\n"
    f" * has {_MEASURED_OPERATIONS} operations: {_MEASURED_INSTRUCTIONS / _CLOCK_MHZ:.0f} us at {_CLOCK_MHZ:g} MHz "
    "and an instruction a cycle; its some 40 divisions of 14 cycles take 3 us more."
)


def _size(parameters: int) -> int:
    """sizeof(servo_estimator) where every member but the last bytes has four."""
    states = 3 + parameters
    return 4 * (states * states + states + 4 * parameters + 41)


def _std(model: ExportedModel, name: str) -> float:
    """As the filter has it: relative for a positive parameter; 0 where it is not known."""
    value = model.values[name]
    if value.std is None:
        return 0.0
    return value.std / value.value if parameter_table()[name].transform == "log" else value.std


def _array(values: list[float]) -> str:
    return ", ".join(literal(value) for value in values)


def _filled(template: str, values: dict[str, str]) -> bytes:
    text = files("servo_daemon.export.c").joinpath(template).read_text(encoding="utf-8")
    for name, value in values.items():
        text = text.replace(f"@{name}@", value)
    return text.encode()


TARGET = Target("c", ".c", write)
