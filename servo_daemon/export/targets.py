"""Every target by its name; its file is imported when it is asked for."""

from __future__ import annotations

from importlib import import_module

from servo_daemon.export.model import Target

_MODULES = {
    "json": "json_file",
    "python": "python_file",
    "mujoco": "mujoco",
    "urdf": "urdf",
    "sdf": "sdf",
    "isaac": "isaac",
    "modelica": "modelica",
    "simulink": "simulink",
    "c": "c.write",
    "fmu": "fmu.write",
}
NAMES = tuple(_MODULES)


def target(name: str) -> Target:
    """Raises KeyError: there is no such target."""
    found = import_module(f"servo_daemon.export.{_MODULES[name]}").TARGET
    assert isinstance(found, Target)
    return found
