"""What a search may cost, and what it leaves for the next one."""

from __future__ import annotations

from pathlib import Path

from servo_daemon.diagnosis.search.effort import Effort, Journal, model_key


def test_beyond_its_budget_nothing_is_begun_and_all_of_it_is_noted_once() -> None:
    effort = Effort(budget_s=1e-9)
    assert not any([effort.allows("a"), effort.allows("b"), effort.allows("a")])
    assert effort.unfinished is not None
    assert effort.unfinished.not_tried == ("a", "b") and effort.unfinished.cpu_s > 0


def test_without_a_budget_or_within_it_everything_may_be_tried() -> None:
    for effort in (Effort(), Effort(budget_s=1e9)):
        assert effort.allows("a")
        assert effort.unfinished is None


def test_a_journal_is_for_the_next_search_over_the_same_data(tmp_path: Path) -> None:
    path, key = tmp_path / "journal.jsonl", model_key(("a",), ("a", "b"), 0.5)
    first = Journal(path, "data")
    first.keep(key, {"R": 1.25})
    assert first.values(key) is None, "with a file and without, the same search does the same"
    with path.open("a") as file:
        file.write('{"data": "data", "model": "cut o')
    assert Journal(path, "data").values(key) == {"R": 1.25}
    assert Journal(path, "other data").values(key) is None
    assert Journal(path, "data").values(model_key(("a",), ("a", "b"), 0.25)) is None


def test_a_file_that_cannot_be_written_costs_nothing_but_time(tmp_path: Path) -> None:
    Journal(tmp_path / "no" / "journal.jsonl", "data").keep("model", {"R": 1.0})
    Journal(None, "data").keep("model", {"R": 1.0})
