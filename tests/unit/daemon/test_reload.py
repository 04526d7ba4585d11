"""A configuration read again while the daemon runs: what changes at once, which drives begin again, what is refused."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from servo_daemon.config import Config, parse_config
from servo_daemon.config.changes import at_work, changes
from servo_daemon.daemon import daemon as daemon_module
from servo_daemon.daemon.notify import Notifier
from servo_daemon.daemon.state_lock import StateLocks
from servo_daemon.errors import DriverConfigError, ServoDaemonError
from servo_daemon.simulate import DEFAULT_NOMINAL
from tests.daemon_rig import Fed, Rig, starter


def config(*drives: dict[str, Any], **sections: Any) -> Config:
    shared = {"driver": "fed", "nominal": dict(DEFAULT_NOMINAL), "estimation": {"refresh": False}}
    return parse_config({"drive": [shared | d for d in drives], "storage": {"save_interval_s": 0.05}, **sections})


def follow(rig: Rig, new: Config) -> list[str]:
    """Reload; the lines of the log."""
    changed = changes(rig.daemon.config, new)
    rig.daemon.follow(new, changed)
    return [c.text for c in changed]


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Rig]]:
    with starter(monkeypatch) as begin:
        yield begin


def test_limits_and_gains_count_at_once_and_the_estimates_go_on(start: Callable[..., Rig]) -> None:
    gains = {"speed_kp_V_s_rad": 1.0}
    rig = start(config({"name": "a"}, {"name": "b"}))
    runtime = rig.runtime("a")
    rig.driver("a").feed(4000)
    rig.until_samples(4000, "a")
    R = runtime.snapshot().estimate.parameters[0]  # type: ignore[union-attr]
    assert R.name == "R" and R.status == "tracking" and R.value is not None
    estimation = {"refresh": False, "adopt": "never", "diagnose": "never"}
    lines = follow(
        rig,
        config(
            {"name": "a", "limits": {"R_max": R.value / 2}, "controller": gains, "estimation": estimation},
            {"name": "b"},
        ),
    )
    assert lines == [
        'drive a: estimation.diagnose: "on_mismatch" → "never"',
        'drive a: estimation.adopt: "ask" → "never"',
        f"drive a: limits.R_max: absent → {R.value / 2!r}",
        "drive a: controller.speed_kp_V_s_rad: absent → 1.0",
    ]
    rig.driver("a").feed(500)
    rig.until_samples(4500, "a")
    rig.until(lambda: "alarm" in rig.kinds("a"), "the new alarm rings")
    assert rig.runtime("a") is runtime and rig.kinds("a").count("filter_started") == 1
    assert runtime.loop.in_use is not None and runtime.diagnosis.allowed is False
    estimate = runtime.snapshot().estimate
    assert estimate is not None and "controller_margin_low" in estimate.health
    assert rig.kinds("a").count("reloaded") == 1 and "reloaded" not in rig.kinds("b")
    follow(rig, config({"name": "a", "estimation": estimation}, {"name": "b"}))
    rig.driver("a").feed(500)
    rig.until(lambda: "alarm_cleared" in rig.kinds("a"), "an alarm that is no more has ended")
    assert rig.runtime("a") is runtime and runtime.limits == () and runtime.loop.in_use is None


def test_drives_come_go_and_begin_again(start: Callable[..., Rig], tmp_path: Path) -> None:
    rig = start(config({"name": "a"}, {"name": "b"}, {"name": "c"}), tmp_path)
    for name in "abc":
        rig.driver(name).feed(3000)
        rig.until_samples(3000, name)
    kept, gone = rig.runtime("a"), rig.runtime("c")
    gone_driver, again = rig.driver("c"), rig.driver("b")
    gone_driver.feed(300)  # may be in the queue still
    lines = follow(rig, config({"name": "d"}, {"name": "a"}, {"name": "b", "options": {"seed": 1, "x": "y"}}))
    assert lines == [
        "drive b: options.seed: absent → 1 (the drive begins again)",
        'drive b: options.x: absent → "y" (the drive begins again)',
        "drive c: removed",
        "drive d: new, with driver fed",
    ]
    assert list(rig.daemon.drives) == ["d", "a", "b"] and rig.runtime("a") is kept
    assert not gone.reader.alive and gone.snapshot().counters["samples"] == 3300, "what had come was worked off"
    assert gone.snapshot().estimate is not None and gone.snapshot().estimate.samples == 3300  # type: ignore[union-attr]
    assert (tmp_path / "c.state.json").is_file(), "what was learned stays"
    assert rig.driver("b") is not again and rig.driver("b").options["x"] == "y"
    for name in "dab":
        rig.driver(name).feed(1000)
    rig.until_samples(4000, "a")
    rig.until_samples(1000, "d")
    rig.until_samples(1000, "b")
    assert "state_restored" in rig.kinds("b"), "it goes on from what was saved"
    assert rig.daemon.problems() == []


def test_the_history_holds_both_lives_of_a_drive(start: Callable[..., Rig], tmp_path: Path) -> None:
    nobody = [{"url": "http://127.0.0.1:1/", "kinds": ["connected"]}]
    rig = start(config({"name": "a"}, webhook=nobody), tmp_path)
    rig.driver("a").feed(2000)
    rig.until_samples(2000, "a")
    follow(rig, config({"name": "a", "options": {"seed": 1}}, {"name": "b"}, webhook=nobody))
    rig.until(lambda: rig.daemon.sinks[0].waiting == 3, "a webhook has the events of a's both lives and of b")
    archive = rig.daemon.archive
    assert archive is not None
    recorder = rig.daemon._recording.recorder  # type: ignore[union-attr]
    rig.until(lambda: recorder.sources is recorder.wanted, "the recorder has the new drives")
    kinds = [e.kind for e in archive.events("a", (), None, 100, None).events]
    assert kinds.count("connected") == 2 and kinds.count("reloaded") == 1
    assert archive.events("b", (), None, 100, None).events


def test_what_cannot_be_is_refused_as_a_whole(
    start: Callable[..., Rig], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = start(config({"name": "a"}))
    runtime = rig.runtime("a")

    def picky(kind: str, name: str, options: dict[str, Any]) -> Fed:
        if "bad" in options:
            raise DriverConfigError("unknown option 'bad'")
        return Fed(name, options)

    monkeypatch.setattr(daemon_module, "make_driver", picky)
    new = config({"name": "a", "limits": {"R_max": 1.0}}, {"name": "b"}, {"name": "c", "options": {"bad": 1}})
    with pytest.raises(DriverConfigError):
        follow(rig, new)
    with StateLocks(tmp_path) as own, StateLocks(tmp_path) as other:
        other.take(["b"])
        rig.daemon._locks = own
        with pytest.raises(ServoDaemonError, match="drive b"):
            follow(rig, config({"name": "a", "limits": {"R_max": 1.0}}, {"name": "b"}))
    assert list(rig.daemon.drives) == ["a"] and rig.runtime("a") is runtime
    assert runtime.active.limits.alarms == {} and "reloaded" not in rig.kinds("a")


def test_systemd_is_told(start: Callable[..., Rig], tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        line.bind(str(tmp_path / "notify"))
        line.settimeout(30)
        rig = start(notifier=Notifier(str(tmp_path / "notify")))
        rig.driver().feed(2000)
        heard = ""
        while "READY=1" not in heard:
            heard = line.recv(4096).decode()
        rig.daemon.begin_reload()
        rig.daemon.end_reload()
        told: list[str] = []
        while not told or "READY=1" not in told[-1]:
            told.append(line.recv(4096).decode())
        (reloading,) = (t for t in told if "RELOADING=1" in t)
        assert int(reloading.partition("MONOTONIC_USEC=")[2]) > 0


def test_the_daemons_own_keys() -> None:
    old = config({"name": "a"})
    secret = "postgresql://me:hunter2@db/x"
    hook = {"url": "https://hooks.example/secret-path"}
    new = config(
        {"name": "a"},
        webhook=[hook],
        api={"port": 1, "metrics": "open", "certificate": "c", "private_key": "k"},
        history={"url": secret},
        log={"level": "debug"},
    )
    found = changes(old, new)
    assert [(c.text, c.how) for c in found] == [
        ("api.port: 8077 → 1: needs a restart", "restart"),
        ('api.metrics: "token" → "open"', "now"),
        ('api.certificate: absent → "c": needs a restart', "restart"),
        ('api.private_key: absent → "k": needs a restart', "restart"),
        ('log.level: "info" → "debug"', "now"),
        ('history.url: absent → "postgresql://me:***@db/x": needs a restart', "restart"),
        ('webhook: [] → [{ url = "https://hooks.example/***", kinds = [], drives = [] }]: needs a restart', "restart"),
    ]
    at = at_work(old, new)
    assert (at.api.port, at.api.metrics, at.log.level, at.history.url) == (8077, "open", "debug", None)
    assert [c.how for c in changes(at, new)] == ["restart"] * 5, "what needs a restart is told each time"
    assert changes(new, new) == ()
    other = config({"name": "a"}, api={"certificate": "d", "private_key": "k"})
    assert [c.how for c in changes(new, other) if c.what.startswith("api.cert")] == ["now"]
