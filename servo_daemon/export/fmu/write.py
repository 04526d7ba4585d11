"""`--to fmu`: FMI 2.0 for co-simulation. The plant's own step in C, compiled for this machine, its source beside it."""

from __future__ import annotations

import hashlib
import io
import platform
import subprocess
import sys
import tempfile
import zipfile
from importlib.resources import files
from pathlib import Path
from xml.sax.saxutils import quoteattr

import casadi as ca

from servo_daemon.errors import BadInputError
from servo_daemon.export.model import ASSUMED_PERIOD_S, Export, ExportedModel, Target
from servo_daemon.export.reference import plant_of
from servo_daemon.export.words import common_notes, header, identifier, number
from servo_daemon.plant.build import PlantModel
from servo_daemon.plant.compiler import find_compiler

_INPUTS = {"voltage": ("voltage_V", "V"), "current": ("current_A", "A"), "torque": ("torque_Nm", "N.m")}
_OUTPUTS = (("current_A", "A"), ("velocity_rad_s", "rad/s"), ("position_rad", "rad"))
#: Of a zip's entries: equal content gives equal bytes.
_NO_TIME = (1980, 1, 1, 0, 0, 0)


def write(model: ExportedModel) -> Export:
    """Raises BadInputError: a parameter is not known, or there is no C compiler."""
    values = model.require(model.needed, "fmu")
    compiler = find_compiler()
    if compiler is None:
        raise BadInputError("--to fmu needs a C compiler on this machine (cc, gcc, clang): install one")
    plant, name = plant_of(model), identifier(model.name)
    notes = common_notes(model)
    if model.linear:
        notes.append("a linear axis: rad stand for m, N·m for N")
    source = _source(plant, model, values)
    guid = hashlib.sha256(source.encode()).hexdigest()[:32]
    source = source.replace("@GUID@", guid)
    folder, suffix = _platform()
    description = _description(plant, model, values, guid, [*header(model, notes)])
    content = {
        "modelDescription.xml": description.encode(),
        f"sources/{name}.c": source.encode(),
        f"binaries/{folder}/{name}{suffix}": _compiled(source, compiler, suffix),
    }
    notes.append(f"compiled for {folder}; other machines compile sources/{name}.c")
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for path, data in content.items():
            archive.writestr(zipfile.ZipInfo(path, _NO_TIME), data, zipfile.ZIP_DEFLATED)
    return Export(packed.getvalue(), tuple(notes))


def _platform() -> tuple[str, str]:
    """FMI 2.0's name of this machine and the ending of its libraries (FMI 2.0.4, section 2.3)."""
    bits = "64" if sys.maxsize > 2**32 else "32"
    system, suffix = {"Linux": ("linux", ".so"), "Darwin": ("darwin", ".dylib")}.get(platform.system(), ("win", ".dll"))
    return f"{system}{bits}", suffix


def _source(plant: PlantModel, model: ExportedModel, values: dict[str, float]) -> str:
    """The plant's step and sensors by CasADi, and the wrapper."""
    functions = {"step": plant.step, "sensed": plant.sensed}
    generator = ca.CodeGenerator("plant.c", {"with_header": False})
    sizes = []
    for key, function in functions.items():
        arguments = [ca.SX.sym(f"a{k}", function.numel_in(k)) for k in range(function.n_in())]
        dense = ca.Function(f"servo_plant_{key}", arguments, [ca.densify(r) for r in function.call(arguments)])
        generator.add(dense)
        needs = {"ARG": dense.sz_arg(), "RES": dense.sz_res(), "IW": dense.sz_iw(), "W": dense.sz_w()}
        sizes += [f"#define SZ_{what}_{key.upper()} {size}" for what, size in needs.items()]
    v, i = model.meaning.factors
    gear = model.gear
    filled = {
        "LONGEST": repr(model.sample_period_s or ASSUMED_PERIOD_S),
        "NX": str(len(plant.states)),
        "NP": str(len(plant.parameters)),
        "INITIAL": ", ".join(repr(float(s.initial)) for s in plant.states),
        "PARAMETERS": ", ".join(repr(values[n]) for n in plant.parameter_names),
        "INPUT_FACTOR": repr({"voltage": v, "current": i, "torque": 1.0 / gear}[model.drive]),
        "OUTPUT_FACTORS": ", ".join(map(repr, (1.0 / i, 1.0 / gear, 1.0 / gear))),
    }
    text = files("servo_daemon.export.fmu").joinpath("wrapper.c").read_text(encoding="utf-8")
    for key, value in filled.items():
        text = text.replace(f"@{key}@", value)
    return "\n".join([generator.dump(), *sizes, text])


def _compiled(source: str, compiler: str, suffix: str) -> bytes:
    """Raises BadInputError: the compiler refuses."""
    with tempfile.TemporaryDirectory() as folder:
        c_file, library = Path(folder) / "unit.c", Path(folder) / f"unit{suffix}"
        c_file.write_text(source, encoding="utf-8")
        command = [compiler, "-O2", "-ffp-contract=off", "-fvisibility=hidden", "-fPIC", "-shared", "-w"]
        done = subprocess.run(
            [*command, str(c_file), "-o", str(library), "-lm"], capture_output=True, text=True, check=False
        )
        if done.returncode != 0:
            raise BadInputError(f"--to fmu: {compiler} does not compile it: {done.stderr.strip()[:500]}")
        return library.read_bytes()


def _variable(name: str, reference: int, attributes: str, real: str, what: str) -> str:
    head = f'    <ScalarVariable name={quoteattr(name)} valueReference="{reference}" {attributes}'
    return f"{head} description={quoteattr(what)}>\n      <Real {real}/>\n    </ScalarVariable>"


def _variables(plant: PlantModel, model: ExportedModel, values: dict[str, float]) -> list[str]:
    """Input, outputs, states and parameters; numbered as the wrapper numbers them."""
    given, unit = _INPUTS[model.drive]
    output, state = 'causality="output" variability="continuous"', 'causality="local" variability="continuous"'
    variables = [
        _variable(f"in_{given}", 0, 'causality="input" variability="continuous"', 'start="0"',
                  f"{unit}, as the drive has it, held over a step"),
        *(_variable(shown, 1 + k, output, "", f"{u}, as the drive's sensors show it")
          for k, (shown, u) in enumerate(_OUTPUTS)),
        *(_variable(f"state_{s.name}", 4 + k, state, "", f"{s.unit}, of the motor")
          for k, s in enumerate(plant.states)),
    ]  # fmt: skip
    for k, p in enumerate(plant.parameters):
        value = model.values[p.name]
        std = "" if value.std is None else f" ± {number(value.std)}"
        what = f"{p.description}, {value.unit}{std} ({value.origin})"
        kind = 'causality="parameter" variability="tunable"'
        reference = 4 + len(plant.states) + k
        variables.append(_variable(p.name, reference, kind, f'start="{values[p.name]!r}"', what))
    return variables


def _description(plant: PlantModel, model: ExportedModel, values: dict[str, float], guid: str, head: list[str]) -> str:
    name = identifier(model.name)
    variables = "\n".join(_variables(plant, model, values))
    unknowns = "\n".join(f'      <Unknown index="{k}"/>' for k in (2, 3, 4))
    text = quoteattr("\n".join(head))
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName={quoteattr(model.name)} guid="{guid}" description={text}
    generationTool="servo-daemon" variableNamingConvention="flat" numberOfEventIndicators="0">
  <CoSimulation modelIdentifier="{name}" canHandleVariableCommunicationStepSize="true"
      canGetAndSetFMUstate="true" canSerializeFMUstate="true">
    <SourceFiles>
      <File name="{name}.c"/>
    </SourceFiles>
  </CoSimulation>
  <ModelVariables>
{variables}
  </ModelVariables>
  <ModelStructure>
    <Outputs>
{unknowns}
    </Outputs>
    <InitialUnknowns>
{unknowns}
    </InitialUnknowns>
  </ModelStructure>
</fmiModelDescription>
"""


TARGET = Target("fmu", ".fmu", write)
