"""A few hundred inputs for each decoder and reader; a million: `python -m tests.fuzz`."""

from __future__ import annotations

from pathlib import Path
from random import Random

import pytest

from servo_daemon.captures.columns.signal_map import load_signal_map
from servo_daemon.commands.excite import diagnosis
from servo_daemon.commands.export import source
from servo_daemon.errors import BadInputError
from tests.fuzz import targets
from tests.fuzz.__main__ import feed
from tests.fuzz.targets import TARGETS, Target

#: A model has to be trained first, which takes seconds.
QUICK = [name for name in TARGETS if name != "model files"]


@pytest.mark.parametrize("name", QUICK)
def test_a_few_inputs(name: str) -> None:
    assert feed(name, max(20, round(3000 * TARGETS[name].share)), seed=2) == {}


def test_a_reader_that_fails_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(random: Random, _: Path) -> targets.Step:
        nothing = dict[str, None]()
        return lambda: None if random.randrange(4) else nothing["x"]

    monkeypatch.setitem(TARGETS, "slcan", Target(broken, 1.0))  # type: ignore[arg-type]
    ((what, times),) = feed("slcan", 100, seed=1).items()
    assert what.startswith("KeyError in test_fuzz.py:") and 10 < times < 50


@pytest.mark.parametrize(
    ("read", "text"),
    [
        (load_signal_map, "a = " + "[" * 5000),
        (lambda path: diagnosis.read_tied(path, ()), '{"a":' * 5000),
        (lambda path: source.from_document(path, None), "[" * 5000),
    ],
)
def test_a_document_nested_too_deeply_is_refused(tmp_path: Path, read: targets.Reader, text: str) -> None:
    path = tmp_path / "deep"
    path.write_text(text)
    with pytest.raises(BadInputError, match=r"deep: .*recursion") as error:
        read(path)
    assert len(str(error.value).splitlines()) == 1
