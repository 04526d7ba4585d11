"""What is left beside a named effect: too much only where free runs err beyond the noise, too."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from servo_daemon.diagnosis.verdict import remains


@pytest.mark.parametrize(
    ("left", "explained", "by_noise", "much"),
    [
        (0.0010, 0.010, False, False),  # less than what is ever looked at
        (0.0100, 0.100, False, False),  # a tenth of what the effects explain
        (0.0300, 0.100, False, True),
        (0.0300, 0.100, True, False),  # the voltage's noise, through the winding
    ],
)
def test_what_is_left_is_much_if_it_is_no_noise(
    monkeypatch: pytest.MonkeyPatch, left: float, explained: float, by_noise: bool, much: bool
) -> None:
    monkeypatch.setattr(remains, "_left", lambda _: left)
    monkeypatch.setattr(remains, "_explained", lambda *_: explained)
    monkeypatch.setattr(remains, "errs_by_noise", lambda *_: by_noise)
    selection: Any = SimpleNamespace(data=None, chosen=None)
    nothing = cast(Any, None)
    assert remains.leaves_much(selection, nothing, nothing, nothing) is much
