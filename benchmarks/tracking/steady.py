"""`steady`: what forgetting costs where nothing changes. The std of the regression on the motors and motions of
`witness`, over the std that commit 4bd4e7b had on the same samples (`steady_reference.jsonl`, this part's own `--out`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from servo_daemon.samples import F64
from tests.recovery.tracking.witness import RMS_LIMIT, run_witness, runs_of
from tests.recovery.tracking.wrong import Journal, each

REFERENCE = Path(__file__).with_name("steady_reference.jsonl")
#: Issue 25: std over the reference's.
LIMIT = 1.5
SECONDS = 150.0


def reference() -> Mapping[str, F64]:
    """Run's key -> relative std of R, K, J and B (median from 20 s on), shape (4,)."""
    rows = [json.loads(line) for line in REFERENCE.read_text().splitlines()] if REFERENCE.exists() else []
    return {row["key"]: np.array(row["std"]) for row in rows}


def report_steady(runs: int, only: str, *, processes: int = 2, out: Path | None = None) -> None:
    """Prints each run as it comes, then the geometric mean and the worst of the ratios."""
    print(f"\nSteady motors: std of rls over that of commit 4bd4e7b, {SECONDS:.0f} s at 1 kHz; error over std")
    print(f"{'':26}" + "".join(f"{name:>8}" for name in RMS_LIMIT) + "   rms error over std")
    known, journal, ratios = reference(), Journal(out), []
    for row in each(run_witness, runs_of(runs, SECONDS, only, "steady"), processes):
        rls: Mapping[str, Any] = row["rls"]
        journal.write({"key": row["key"], "std": np.round(rls["std"], 6), "rms": np.round(rls["rms"], 6)})
        ratio = rls["std"] / known.get(row["key"], np.full(len(RMS_LIMIT), np.nan))
        ratios.append(ratio)
        honest = "".join(f"{x:8.2f}" for x in rls["rms"] / rls["std"])
        print(f"  {row['key']:24}" + "".join(f"{x:8.2f}" for x in ratio) + f"   {honest}", flush=True)
    if not ratios:
        return
    middle, worst = np.exp(np.mean(np.log(ratios), axis=0)), np.max(ratios, axis=0)
    print(f"  {'geometric mean':24}" + "".join(f"{x:8.2f}" for x in middle) + f"   limit {LIMIT:g}")
    beyond = int((np.array(ratios) > LIMIT).sum())
    print(
        f"  {'worst':24}" + "".join(f"{x:8.2f}" for x in worst) + f"   beyond {LIMIT:g}: {beyond} of {np.size(ratios)}"
    )
