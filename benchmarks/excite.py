"""Planned motions against a multisine of equal length and limits, on the independent generator's motors.

    python benchmarks/excite.py             # three pairs of causes, both motions, three seeds; and a motor with weak L
    python benchmarks/excite.py --quick     # one seed

The plan knows nominal values that are wrong by 4 to 15 % and of the effects their names only. Both models are fitted to
the noisy capture (20 s at 1 kHz); what is told is the gain of the true model over the wrong one in the held-out part:
mean over channels of log(rms error of the wrong / of the true), with its 98 % interval; a pair is separated where that
is above 0.02 and BIC agrees, which is how a diagnosis decides.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.recovery.excitation_trials import determined, judged, planned, rival
from tests.recovery.generator import RE40, Motor

#: Motor, the true cause, the other, its share of the working torque.
PAIRS: tuple[tuple[Motor, str, str, float], ...] = (
    (RE40, "stribeck_friction", "coulomb_friction", 0.02),
    (RE40, "load_dependent_friction", "coulomb_friction", 0.01),
    (RE40, "stribeck_friction", "asymmetric_friction", 0.02),
)


def pairs(seeds: range) -> None:
    """A table of the three pairs."""
    print(f"{'truth / other':<48} {'seed':>4}  {'multisine: gain [98 %]':<28} {'plan: gain [98 %]':<28}")
    for motor, true, other, share in PAIRS:
        began = time.process_time()
        plan = planned(motor, between=(true, other))
        took = time.process_time() - began
        for seed in seeds:
            texts = []
            for voltage in (rival(motor, seed), plan.reference):
                v = judged(motor, voltage, true, other, share, seed)
                a = v.against
                texts.append(f"{a.gain:6.3f} [{a.low:6.3f}, {a.high:6.3f}] {'yes' if v.separated else 'no':<3}")
            print(f"{motor.name}: {true} / {other:<24} {seed:>4}  {texts[0]:<28} {texts[1]:<28}", flush=True)
        print(f"    planned in {took:.1f} s of CPU: {', '.join(dict.fromkeys(b.text for b in plan.blocks))}")


def weak(seeds: range) -> None:
    """Standard deviations of a motor with weak L."""
    began = time.process_time()
    plan = planned(RE40, wanted=("L",))
    print(f"\n{RE40.name}: plan for L in {time.process_time() - began:.1f} s of CPU; std as `fit` finds it:")
    ratios = []
    for seed in seeds:
        theirs = determined(RE40, rival(RE40, seed), seed)["L"]
        ours = determined(RE40, plan.reference, seed)["L"]
        assert theirs.std is not None and ours.std is not None
        ratios.append(theirs.std / ours.std)
        error = abs(ours.value or 0.0) - RE40.L
        print(
            f"  seed {seed}: multisine ± {100 * theirs.std / RE40.L:.3f} %, plan ± {100 * ours.std / RE40.L:.3f} % "
            f"(off by {error / ours.std:+.1f} std): {ratios[-1]:.2f} times as well"
        )
    print(f"  geometric mean: {np.exp(np.mean(np.log(ratios))):.2f} times as well")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one seed")
    seeds = range(1) if parser.parse_args().quick else range(3)
    weak(seeds)
    pairs(seeds)


if __name__ == "__main__":
    main()
