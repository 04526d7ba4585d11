"""EST.csv: the pipeline's estimates over a capture as a table.

Columns: `time_s`; for every parameter P of the model `P, P_std, P_status`, in the order R, L, K, J, B, the effects'
own parameters as the model lists them, J_d last; then the same with the prefix of each estimator that exists.
"""

from __future__ import annotations

import gzip
import re
import zlib
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

from servo_daemon.errors import BadInputError
from servo_daemon.files import AtomicFile
from servo_daemon.parameters import J_D, LINEAR
from servo_daemon.published.snapshot import Estimate, EstimatorView, finite_or_none

#: Prefixes in their order in the file.
ESTIMATORS = ("ekf", "rls", "grnn")
#: No ending at all (/dev/stdout), or that of a table of text.
_CSV_NAME = re.compile(r"^[^.]*$|\.csv(\.gz)?$", re.IGNORECASE)

#: The first parameter's status is within the first hundred bytes; a file that is none of ours may be one long line.
_HEADER_BYTES = 4096


def parameter_order(names: Sequence[str]) -> tuple[str, ...]:
    """The order of the columns: the linear motor's parameters, the effects' as given, J_d."""
    linear = tuple(p.name for p in LINEAR if p.name in names)
    own = tuple(name for name in names if name not in linear and name != J_D.name)
    return (*linear, *own, *((J_D.name,) if J_D.name in names else ()))


def is_estimates(path: Path) -> bool:
    """Whether the file has the header of one that `EstimatesWriter` wrote: what can be computed again may be."""
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            header = file.readline(_HEADER_BYTES)
    except (OSError, EOFError, zlib.error):
        return False
    return header.startswith(b"time_s,") and b"_status," in header


class EstimatesWriter:
    """Writes EST.csv (`.gz` compresses) row by row; the file gets its name on `close`.

    As a context manager it leaves no file if the block ends in an exception. Equal estimates give equal bytes.

    Args:
        path: the file.
        parameters: names of the model's parameters, in any order.
        estimators: those that exist, of `ESTIMATORS`; they give columns even before they have said anything.

    Raises:
        ValueError: an estimator that does not exist.
        BadInputError: the file cannot be created, or its name promises another format.
    """

    def __init__(self, path: Path | str, parameters: Sequence[str], estimators: Sequence[str] = ()) -> None:
        if not _CSV_NAME.search(Path(path).name):
            raise BadInputError(f"{path}: estimates are written as CSV: name it .csv or .csv.gz")
        if unknown := set(estimators) - set(ESTIMATORS):
            raise ValueError(f"unknown estimators {sorted(unknown)}: known are {', '.join(ESTIMATORS)}")
        self._parameters = parameter_order(parameters)
        self._estimators = tuple(name for name in ESTIMATORS if name in estimators)
        self._output = AtomicFile(Path(path))
        self._output.write(f"{','.join(self.columns)}\n".encode())

    @property
    def columns(self) -> tuple[str, ...]:
        """The header's column names."""
        prefixes = ("", *(f"{name}_" for name in self._estimators))
        cells = (f"{x}{p}{end}" for x in prefixes for p in self._parameters for end in ("", "_std", "_status"))
        return ("time_s", *cells)

    def write(self, estimate: Estimate) -> None:
        """Append one row. `estimate.time_s` is written so that it reads back as the same double.

        Raises:
            ValueError: the estimate has a parameter or an estimator without a column: the model changed.
            ServoDaemonError: the disk refuses.
        """
        self._output.write(f"{','.join(self._row(estimate))}\n".encode())

    def _row(self, estimate: Estimate) -> list[str]:
        fused = {p.name: (p.value, p.std, p.status) for p in estimate.parameters}
        self._check_known(estimate)
        row = [repr(float(estimate.time_s))]
        for name in self._parameters:
            value, std, status = fused.get(name, (None, None, ""))
            row += (_cell(value), _cell(std), status)
        for estimator in self._estimators:
            row += self._view_cells(estimate.estimators.get(estimator))
        return row

    def _check_known(self, estimate: Estimate) -> None:
        known = set(self._parameters)
        unknown = {p.name for p in estimate.parameters} - known
        unknown |= set(estimate.estimators) - set(self._estimators)
        for name, view in estimate.estimators.items():
            unknown |= {f"{name}_{p}" for p in set(view.parameters) - known}
        if unknown:
            raise ValueError(f"no columns for {', '.join(sorted(unknown))}")

    def _view_cells(self, view: EstimatorView | None) -> list[str]:
        cells: list[str] = []
        for name in self._parameters:
            value, std = view.parameters.get(name, (None, None)) if view else (None, None)
            status = view.status.get(name, "") if view else ""
            cells += (_cell(value), _cell(std), status)
        return cells

    def close(self) -> None:
        """Give the file its name. Idempotent.

        Raises:
            ServoDaemonError: the disk refuses; no file is left.
        """
        try:
            self._output.commit()
        finally:
            self._output.discard()

    def discard(self) -> None:
        """Close without leaving a file."""
        self._output.discard()

    def __enter__(self) -> EstimatesWriter:
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        if exc_type is None:
            self.close()
        else:
            self.discard()


def _cell(value: float | None) -> str:
    """Shortest decimals that read back exactly; empty where there is no number."""
    number = finite_or_none(value)
    return "" if number is None else repr(number)
