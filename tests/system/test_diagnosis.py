"""A drive on a serial line with a friction that its model lacks: the daemon sees the mismatch, has it diagnosed, and
adopts what was found while the samples flow.

The drive is a motor of the independent generator behind the real wire on a pseudo-terminal.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

import pytest

from drivers.base import DriveInfo
from servo_daemon.errors import EndOfStreamError
from servo_daemon.samples import SampleBlock, make_block
from servo_daemon.sim_drive.serial_device import run_serial_device
from tests.recovery.generator import GEAR_MOTOR, Recording, Scenario, Sensors, find_compiler, generate
from tests.system.harness import DaemonProgram, daemon, environment, wait_for, write_config
from tests.system.test_links import device

TC = 0.15 * GEAR_MOTOR.working_torque_Nm


class Recorded:
    """A recording as a device's source of samples, at twice its own pace; a line that is slower is waited for, so that
    whatever is lost the daemon has lost."""

    _SPEED = 2.0

    def __init__(self, recording: Recording) -> None:
        self._began: float | None = None
        self._block = make_block(
            recording.time_s.copy(),
            voltage_V=recording.voltage_V.copy(),
            current_A=recording.current_A.copy(),
            position_rad=recording.position_rad.copy(),
        )
        self._taken = 0
        steps = Sensors.laboratory(GEAR_MOTOR)
        self.info = DriveInfo(
            "bench", counts_per_rev=steps.counts_per_rev, current_lsb_A=steps.current_lsb_A,
            voltage_lsb_V=steps.voltage_lsb_V, channels=self._block.channels,
        )  # fmt: skip

    def next_block(self, n: int) -> SampleBlock:
        if self._taken >= len(self._block):
            raise EndOfStreamError("the recording is at its end")
        a, self._taken = self._taken, self._taken + n
        now = time.monotonic()
        self._began = now if self._began is None else self._began
        time.sleep(max(0.0, self._began + float(self._block.time_s[a]) / self._SPEED - now))
        return self._block.slice(a, min(self._taken, len(self._block)))


@pytest.fixture
def program(missing: Callable[[str], NoReturn], tmp_path: Path) -> Iterator[DaemonProgram]:
    if find_compiler() is None:
        missing("a C compiler: the independent generator cannot be built")
    friction = {"coulomb_friction": {"Tc": TC}}
    recording = generate(GEAR_MOTOR, Scenario("multisine", seconds=1000.0, effects=friction, seed=6))
    link = tmp_path / "servo0"
    config = write_config(
        tmp_path / "c.toml",
        f'name = "axis1"\ndriver = "serial"\n[drive.nominal]\nR = 2.5\n[drive.estimation]\nring_s = 15\n'
        f'[drive.options]\nport = "{link}"',
        head="[storage]\nsave_interval_s = 0.2\n",
    )
    with (
        device(run_serial_device, link, source=Recorded(recording), realtime=False),
        daemon("--config", config, "--state-dir", tmp_path / "state", env=environment()) as running,
    ):
        yield running


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_what_the_model_lacks_is_found_adopted_and_kept(program: DaemonProgram, tmp_path: Path) -> None:
    def document() -> dict[str, Any]:
        return program.get("/drives/axis1/diagnosis")  # type: ignore[no-any-return]

    program.until(lambda d: d["health"].get("innovation_white") is False, "the mismatch is seen")
    wait_for(lambda: (d := document())["status"] == "running" or d["request"]["reason"], "why it waits is told")
    wait_for(lambda: document()["status"] == "running", "the mismatch watch begins a diagnosis")
    done = wait_for(lambda: d if (d := document())["status"] in ("done", "failed") else None, "the verdict", 450.0)
    assert done["status"] == "done", done
    assert done["trigger"] == "mismatch" and done["model"] == [] and done["span_s"] > 13
    assert done["result"]["verdict"] == "found"
    assert [e["name"] for e in done["result"]["effects"]] == ["coulomb_friction"]
    report = program.client.get(done["report"])
    assert report.status_code == 200 and report.headers["content-type"].startswith("text/html")

    assert done["adoption"] == {"allowed": True, "reason": None, "effects": ["coulomb_friction"]}
    answer = program.client.post("/api/v1/drives/axis1/model", json={"effects": done["adoption"]["effects"]})
    assert answer.status_code == 200, answer.text
    assert answer.json()["model"] == ["coulomb_friction"] and answer.json()["done"] and answer.json()["time"]

    def settled(d: dict[str, Any]) -> bool:
        known = {n for n, p in d["parameters"].items() if p["status"] == "tracking"}
        return d["health"].get("innovation_white") is True and {"R", "K", "J", "B", "Tc"} <= known

    after = program.until(settled, "the innovations are white, and the friction is known")
    found = after["parameters"]["Tc"]
    assert abs(found["value"] - TC) < max(4 * found["std"], 0.05 * TC)
    for name in ("R", "K", "J", "B"):
        assert after["parameters"][name]["value"] == pytest.approx(getattr(GEAR_MOTOR, name), rel=0.05)
    assert after["health"]["samples_lost"] == 0 and after["health"]["queue_dropped"] == 0
    kinds = program.events()
    told = ["model_mismatch", "diagnosis_started", "diagnosis_done", "model_changed"]
    # In this order; a mismatch is told anew each time that the innovations have been white in between.
    assert list(dict.fromkeys(k for k in kinds if k in told)) == told, kinds
    history = wait_for(
        lambda: h if (h := program.get("/drives/axis1/history?parameter=Tc")).get("points") else None, "its history"
    )
    assert history["unit"] == "N·m"
    state = tmp_path / "state" / "axis1.state.json"
    wait_for(lambda: json.loads(state.read_text())["model"] == ["coulomb_friction"], "it is kept over a restart")
    assert json.loads(state.read_text())["adopted"]["configured"] == []
    program.stop()
