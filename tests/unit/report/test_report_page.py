"""The file that a report becomes."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from servo_daemon import __version__
from servo_daemon.api.access.guard import Guard
from servo_daemon.errors import BadInputError
from servo_daemon.report import (
    Axis,
    Bar,
    Bars,
    Column,
    Line,
    Measured,
    Provenance,
    Report,
    Section,
    Table,
    TimeSeries,
    content_security_policy,
    make_provenance,
    render_report,
    write_report,
)
from servo_daemon.report.blocks import table_html
from servo_daemon.report.equations import equation_html
from servo_daemon.report.numbers import fixed_text, measured_text, number_text
from tests.http_rig import Client
from tests.report_demo import HOSTILE, demo_report


class Reader(HTMLParser):
    """Every tag with its attributes, and the text of each script and style."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.inside: list[tuple[str, str]] = []
        self.words: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if self.tags and self.cdata_elem:
            self.inside.append((self.cdata_elem, data))
        else:
            self.words.append(data)


@pytest.fixture(scope="module")
def page() -> str:
    return render_report(demo_report(10.0))


def data_of(page: str) -> str:
    (text,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    return str(text)


def test_text_from_files_stays_text(page: str) -> None:
    reader = Reader(page)
    tags = [tag for tag, _ in reader.tags]
    assert not {"img", "iframe", "object", "base", "form"} & set(tags)
    assert tags.count("script") == 2
    assert not any(name.startswith("on") or name in {"style", "src"} for _, found in reader.tags for name in found)
    shown = HOSTILE.replace("\x00", "\ufffd")
    assert sum(shown in word for word in reader.words) == 2
    assert "\x00" not in page


def test_every_string_of_a_report_is_escaped() -> None:
    x, evil = np.arange(2.0), '"><b id=evil>&lt;'
    mark = demo_report(1.0).sections[1].blocks[0].marks[0]  # type: ignore[union-attr]
    figure = TimeSeries(evil, x, (Line(evil, x),), Axis(evil, evil), evil, marks=(replace(mark, label=evil),))
    bars = Bars(evil, (Bar(evil, 1.0, note=evil),), Axis(evil, evil), evil, heading=evil)
    table = Table(evil, (Column(evil, evil), Column(evil, text=True)), ((evil, evil),), evil)
    made = Provenance(evil, evil, datetime.now(UTC))
    page = render_report(Report(evil, evil, (Section(evil, (figure, bars, table)),) * 3, made))
    assert "<b" not in re.sub(r"<(body|button)\b", "", re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL))
    reader = Reader(page)
    assert all(found.get("id") != "evil" for _, found in reader.tags)
    assert "<b" not in data_of(page)
    assert json.loads(data_of(page))["figures"][0]["marks"] == [[20.0, evil]]


def test_nothing_is_fetched_and_only_our_own_script_runs(page: str) -> None:
    reader = Reader(page)
    addresses = {v for _, found in reader.tags for k, v in found.items() if k in {"href", "src", "action"}}
    assert {a for a in addresses if not a.startswith("#")} == {"data:,"}
    (policy,) = (found["content"] for tag, found in reader.tags if found.get("http-equiv"))
    assert policy is not None
    assert policy.startswith("default-src 'none'; ")
    assert "unsafe" not in policy
    blocks = re.findall(r"<(script|style)>(.*?)</\1>", page, re.DOTALL)
    assert [kind for kind, _ in blocks] == ["style", "script"]
    for kind, text in blocks:
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{kind}-src 'sha256-{digest}';" in policy
        assert f"{kind}-src 'sha256-{digest}';" in content_security_policy()
    assert "Permission is hereby granted" in page, "uPlot's licence goes where uPlot goes"


def test_the_guard_leaves_the_reports_policy_and_gives_its_own_to_all_else() -> None:
    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        own = {"Content-Security-Policy": content_security_policy()} if scope["path"] == "/report" else {}
        await Response("", headers=own)(scope, receive, send)

    client = Client(Guard(app, tuple))
    assert client.get("/report").headers.get_list("content-security-policy") == [content_security_policy()]
    assert "script-src 'self'" in client.get("/").headers["content-security-policy"]
    assert client.get("/report").headers["x-content-type-options"] == "nosniff"


def test_data_are_json_without_nan(page: str) -> None:
    def refuse(name: str) -> None:
        raise AssertionError(f"{name} in the data")

    figures = json.loads(data_of(page), parse_constant=refuse)["figures"]
    assert [f["kind"] for f in figures] == ["lines"] * 4 + ["scatter", "lines", "iterations"]
    assert [f["group"] for f in figures] == ["time"] * 4 + ["", "frequency", "iteration"]
    without_script = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    assert not re.search(r"\bnan\b|\binf\b", without_script, re.IGNORECASE)


def test_a_minute_at_1_khz_in_six_figures_of_several_series_stays_small() -> None:
    t = np.arange(60_000) / 1000
    noise = np.random.default_rng(0).standard_normal((6, t.size))
    lines = tuple(Line(str(k), y, y - 1, y + 1) if k == 0 else Line(str(k), y) for k, y in enumerate(noise[:3]))
    figures = tuple(TimeSeries(f"figure {k}", t, lines, Axis("current", "A")) for k in range(6))
    made = Provenance("", "", datetime.now(UTC))
    assert len(render_report(Report("", "", (Section("", figures),), made)).encode()) < 3_000_000
    assert len(render_report(demo_report()).encode()) < 2_500_000


def test_equal_reports_are_equal_files_but_for_the_date(page: str) -> None:
    assert render_report(demo_report(10.0)) == page
    report = demo_report(10.0)
    later = replace(report, provenance=replace(report.provenance, made=datetime(2027, 1, 2, 3, 4, 5, tzinfo=UTC)))
    lines = [(a, b) for a, b in zip(page.split("\n"), render_report(later).split("\n"), strict=True) if a != b]
    ((before, after),) = lines
    assert before.replace("2026-03-01 12:00:00 UTC", "2027-01-02 03:04:05 UTC") == after


def test_the_file_says_where_it_comes_from(tmp_path: Path) -> None:
    capture = tmp_path / "a b.csv"
    capture.write_bytes(b"time_s\n")
    made = datetime(2026, 7, 1, 1, 30, tzinfo=timezone(timedelta(hours=2)))
    provenance = make_provenance(["fit", "a b.csv", "--fix", "R=1"], [capture], made)
    path = tmp_path / "report.html"
    write_report(path, Report("Fit", "", (), provenance))
    text = path.read_text(encoding="utf-8")
    for expected in (
        "servo-daemon fit &#x27;a b.csv&#x27; --fix R=1",
        f"servo-daemon {__version__}",
        "2026-06-30 23:30:00 UTC",
        "a b.csv",
        hashlib.sha256(b"time_s\n").hexdigest(),
    ):
        assert expected in text
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a b.csv", "report.html"]
    assert make_provenance([]).made.tzinfo is UTC
    with pytest.raises(ValueError, match="time zone"):
        replace(provenance, made=datetime(2026, 7, 1))
    with pytest.raises(BadInputError, match=r"nothing\.csv: cannot be read"):
        make_provenance([], [tmp_path / "nothing.csv"])
    with pytest.raises(BadInputError, match="cannot be written"):
        write_report(tmp_path / "no" / "report.html", Report("Fit", "", (), provenance))


def test_a_failed_report_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    path.write_text("old")
    log = Axis("f", log=True)
    figure = TimeSeries("f", np.zeros(1), (Line("a", np.ones(1)),), Axis("y"), x_axis=log)
    made = Provenance("", "", datetime.now(UTC))
    with pytest.raises(ValueError, match="shows none"):
        write_report(path, Report("", "", (Section("", (figure,)),), made))
    assert (path.read_text(), len(list(tmp_path.iterdir()))) == ("old", 1)


def test_figures_and_tables_can_be_read_without_seeing_them(page: str) -> None:
    reader = Reader(page)
    canvases = [found for _, found in reader.tags if found.get("class") == "canvas"]
    assert len(canvases) == 7
    for found in canvases:
        assert found["role"] == "img"
        assert found["tabindex"] == "0"
        assert " over " in str(found["aria-label"])
    buttons = [found for tag, found in reader.tags if tag == "button"]
    assert all(found["type"] == "button" and ("aria-label" in found or "aria-pressed" in found) for found in buttons)
    headings = [found for tag, found in reader.tags if tag == "th"]
    assert headings
    assert all(found["scope"] in {"row", "col"} for found in headings)
    levels = [int(tag[1]) for tag, _ in reader.tags if re.fullmatch(r"h\d", tag)]
    assert (levels[0], levels.count(1)) == (1, 1)
    assert all(b - a <= 1 for a, b in pairwise(levels))


def test_tables() -> None:
    columns = (Column("name", text=True), Column("value", "Ω"), Column("r", decimals=2))
    rows = (("R", Measured(0.4937, 0.00123), -0.001), ("L", Measured(None, None), float("nan")), ("n", 12345, 1.0))
    html = table_html(Table("Parameters", columns, rows, chosen=(0,)))
    assert re.sub(r"<[^>]+>", " ", html).split() == (
        "Parameters name value Ω r R ◀ 0.4937 ± 0.0012 0.00 L – – n 12\u202f345 1.00".replace("\u202f", " ").split()
    )
    with pytest.raises(ValueError, match="row 1 has 1 cells, not 3"):
        Table("Parameters", columns, (rows[0], ("R",)))
    with pytest.raises(ValueError, match="no rows"):
        Table("Parameters", columns, rows, chosen=(3,))


def test_bars_stand_where_their_numbers_are() -> None:
    bars = (Bar("a", 0.5, 0.25, 0.75), Bar("b", -0.25, float("-inf"), None), Bar("c", float("nan")))
    page = render_report(
        Report("", "", (Section("", (Bars("t", bars, Axis("gain")),)),), Provenance("", "", datetime.now(UTC)))
    )
    low, high = -0.25 - 0.06, 0.75 + 0.06
    place = [f"{100 * (v - low) / (high - low):.2f}%" for v in (0.0, 0.5, 0.25, 0.75, -0.25)]
    first, second, third = re.findall(r"<tr><th scope=\"row\">.*?</tr>", page)
    assert f'<rect class="bar" x="{place[0]}"' in first
    assert f'<line class="whisker" x1="{place[2]}" x2="{place[3]}"' in first
    assert f'<rect class="bar" x="{place[4]}"' in second
    assert '<line class="whisker" x1="0.00%" x2="100.00%"' in second
    assert "−∞ … ∞" in second
    assert ">−0.250 <" in second
    assert "rect" not in third
    assert "–" in third


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (0.49369, 4, "0.4937"), (-12.3, 4, "−12.30"), (0.0, 3, "0"), (-0.0, 3, "0"), (9.9996, 4, "10.00"),
        (9.751e-6, 3, "9.75×10⁻⁶"), (-2.5e9, 2, "−2.5×10⁹"), (999_999.7, 4, "1.000×10⁶"), (308.1, 4, "308.1"),
        (123_456.0, 4, "123456"), (None, 4, "–"), (float("nan"), 4, "–"), (float("inf"), 4, "∞"),
        (float("-inf"), 4, "−∞"), (-1234567, 4, "−1\u202f234\u202f567"), (np.float64(1.5), 2, "1.5"),
    ],
)  # fmt: skip
def test_numbers(value: float | None, digits: int, text: str) -> None:
    assert number_text(value, digits) == text


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (0.4937, 0.00123, "0.4937 ± 0.0012"), (9.751e-3, 1.2e-5, "(9.751 ± 0.012)×10⁻³"),
        (-5.0, 0.0996, "−5.00 ± 0.10"),
        (0.49, float("inf"), "0.49 ± ∞"), (None, 0.1, "–"), (1.5, None, "1.500"), (1.5, float("nan"), "1.500"),
        (0.0, 2e-7, "(0.0 ± 2.0)×10⁻⁷"), (2.0, 0.0, "2.000 ± 0.000"), (308.1, 45.6, "308 ± 46"),
        (1234.0, 170.0, "1234 ± 170"),
    ],
)  # fmt: skip
def test_measured_values(value: float | None, std: float | None, text: str) -> None:
    assert measured_text(value, std) == text
    assert fixed_text(0.0004, 2) == "0.00"


@pytest.mark.parametrize(
    "latex",
    [
        r"J\,\dot{\omega} = K\,i - B\,\omega - \tau_c\,\operatorname{sgn}(\omega)",
        r"\tau = \begin{cases} \tau_c & \omega > 0 \\ -\tau_c & \omega < 0 \end{cases}",
        r"\sum_{k=1}^{n} a_k \cos(k\,N\theta + \varphi_k)",
        r"R(T) = R_0\,\bigl(1 + \alpha\,(T - T_0)\bigr), \quad \sqrt{x^2}, \quad e^{-|\omega|/v_s}",
        r"T_\mathrm{load} \text{ at rest}",
        r"\left.\frac{\partial \hat y}{\partial p}\right|_{t}",
    ],
)
def test_equations(latex: str) -> None:
    html = equation_html(latex)
    assert html.startswith("<math ")
    (_, attributes), *rest = Reader(html).tags
    assert attributes["alttext"] == latex
    assert {tag for tag, _ in rest} <= {
        "mrow", "mi", "mo", "mn", "mtext", "mspace", "mfrac", "mover", "msub", "msup", "msubsup", "munderover",
        "mtable", "mtr", "mtd", "msqrt", "munder",
    }  # fmt: skip


@pytest.mark.parametrize(
    "latex",
    [
        "", r"\frac{", "}{", r"\nonsense{x}", r"\text{<img src=x onerror=alert(1)>}", r"\text{<b></b>}", "a & b",
        r"\left(", HOSTILE, r"\text{</math><script>alert(1)</script>}",
    ],
)  # fmt: skip
def test_what_is_no_equation_is_shown_as_it_is(latex: str) -> None:
    html = equation_html(latex)
    assert html.startswith("<code>")
    assert "<" not in html.removeprefix("<code>").removesuffix("</code>")


def test_an_equation_carries_no_markup_of_its_own() -> None:
    for latex in (r"\href{javascript:alert(1)}{x}", r"\style{color:red}{x}", r"\color{red\"onload=x}{a}", "</math>"):
        for _, attributes in Reader(equation_html(latex)).tags:
            assert set(attributes) <= {"alttext", "display", "stretchy"}
