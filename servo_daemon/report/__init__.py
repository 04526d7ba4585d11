"""Reports: one self-contained HTML file with texts, tables and zoomable figures.

Knows samples' array types, errors and the way files are written; nothing of estimators, plant or daemon. A command
fills the dataclasses of `document` and `figures` and calls `write_report`.
"""

from servo_daemon.report.document import (
    CaptureFile,
    Code,
    Column,
    Equation,
    Items,
    Measured,
    Provenance,
    Report,
    Section,
    Table,
    Text,
    Verdict,
)
from servo_daemon.report.figures import (
    Axis,
    Bar,
    Bars,
    Iterations,
    Line,
    Mark,
    Plot,
    Points,
    Scatter,
    Span,
    Spectrum,
    TimeSeries,
)
from servo_daemon.report.page import content_security_policy, render_report
from servo_daemon.report.write import make_provenance, write_report

__all__ = [
    "Axis",
    "Bar",
    "Bars",
    "CaptureFile",
    "Code",
    "Column",
    "Equation",
    "Items",
    "Iterations",
    "Line",
    "Mark",
    "Measured",
    "Plot",
    "Points",
    "Provenance",
    "Report",
    "Scatter",
    "Section",
    "Span",
    "Spectrum",
    "Table",
    "Text",
    "TimeSeries",
    "Verdict",
    "content_security_policy",
    "make_provenance",
    "render_report",
    "write_report",
]
