"""The recording says which answers differ."""

from __future__ import annotations

from tests.identity.recording import differences


def test_a_changed_answer_is_named_and_a_missing_capture_is_not() -> None:
    one = {"answers": {"fit a": "1", "fit b": "2", "fit real": "3"}}
    assert differences(one, {"answers": {"fit a": "1", "fit b": "0"}}) == ["fit b"]
