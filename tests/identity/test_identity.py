"""No answer has changed by a single bit since the references were made."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.identity.recording import differences, machine, record, references


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_every_answer_is_as_it_was_recorded(tmp_path: Path, servo_data: Path) -> None:
    wanted = references()
    if wanted["machine"] != machine():
        pytest.skip(
            "the references were made with other libraries or on another machine: numbers differ in last digits"
        )
    assert differences(wanted, record(tmp_path, servo_data)) == []


def test_a_changed_answer_is_named_and_a_missing_capture_is_not() -> None:
    one = {"answers": {"fit a": "1", "fit b": "2", "fit real": "3"}}
    assert differences(one, {"answers": {"fit a": "1", "fit b": "0"}}) == ["fit b"]
