"""`[drive.options]` of `driver = "cia402"`: what each says, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from drivers.cia402.objects import VOLTAGES, Object, eds_pdos, named
from servo_daemon.errors import DriverConfigError

#: Names of all, beside the bus's.
OPTIONS = (
    "node_id", "pdo", "eds", "sync_s", "counts_per_rev", "rated_current_A", "rated_torque_Nm", "velocity_unit",
    "voltage", "rate_hz", "period_s",
)  # fmt: skip
#: Nodes have the ids 1 .. 127 (CiA 301).
MOST_NODE = 127


def pdos_of(options: Mapping[str, Any], where: str) -> dict[int, list[Object]] | None:
    """Objects of the PDOs that `pdo` or `eds` tell, by identifier; None: neither is given.

    Raises:
        DriverConfigError: they cannot be read, or say nothing that is understood.
    """
    voltage = voltage_of(options, where)
    if "pdo" in options and "eds" in options:
        raise DriverConfigError(f"{where}: 'pdo' or 'eds' says what the PDOs hold, not both")
    if "eds" in options:
        path = Path(str(options["eds"])).expanduser()
        try:
            text = path.read_text(encoding="utf-8", errors="replace")
        except OSError as error:
            raise DriverConfigError(f"{where}: eds {path}: cannot be read: {error.strerror or error}") from error
        return eds_pdos(text, node_id_of(options, where), voltage, f"{where}: {path}")
    table = options.get("pdo")
    if table is None:
        return None
    if not isinstance(table, dict) or not table:
        raise DriverConfigError(f"{where}: pdo must be a table, identifier = [names of objects]")
    pdos = {}
    for key, names in table.items():
        try:
            cob_id = int(key, 0)
        except ValueError:
            cob_id = -1
        if not 0 < cob_id <= 0x7FF or not isinstance(names, list) or not all(isinstance(n, str) for n in names):
            raise DriverConfigError(f'{where}: pdo: {key!r} is not of the form "0x181" = ["position", "torque"]')
        pdos[cob_id] = [named(n, voltage, f"{where}: pdo {key}") for n in names]
    return pdos


def voltage_of(options: Mapping[str, Any], where: str) -> Object | None:
    """The maker's object that holds the voltage; None: none is given.

    Raises:
        DriverConfigError: it is none of the shipped ones, and no object.
    """
    given = options.get("voltage")
    if given is None:
        return None
    if isinstance(given, str) and given in VOLTAGES:
        return VOLTAGES[given]
    keys = {"index", "sub", "bits"}
    if isinstance(given, dict) and keys <= set(given) <= {*keys, "signed", "real", "unit_V"}:
        numbers = [given[k] for k in sorted(keys)] + [given.get("unit_V", 1.0)]
        if all(isinstance(n, int | float) and not isinstance(n, bool) for n in numbers) and given["bits"] in (16, 32):
            index, sub, bits = int(given["index"]), int(given["sub"]), int(given["bits"])
            signed, real = bool(given.get("signed", True)), bool(given.get("real", False))
            return Object(index, sub, "voltage_V", bits, signed, real, float(given.get("unit_V", 1.0)))
    raise DriverConfigError(
        f"{where}: voltage must be one of {', '.join(VOLTAGES)}, or {{index = …, sub = …, bits = 16 or 32, unit_V = …}}"
    )


def node_id_of(options: Mapping[str, Any], where: str) -> int:
    """The drive's number on the bus.

    Raises:
        DriverConfigError: it is no number 1 .. 127.
    """
    value = options.get("node_id", 1)
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= MOST_NODE:
        raise DriverConfigError(f"{where}: node_id must be a whole number 1 .. {MOST_NODE}, not {value!r}")
    return value
