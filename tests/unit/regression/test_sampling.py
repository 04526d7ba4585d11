"""What integrals over samples do not show of a winding."""

from __future__ import annotations

from itertools import pairwise

import pytest

from servo_daemon.regression.sampling import sampled_std, settling
from tests.recovery.generator import RE40
from tests.recovery.tracking.follow import NAMES

VALUES = {name: float(getattr(RE40, name)) for name in NAMES}


@pytest.mark.parametrize("period_s", [1e-5, 3e-4, 1e-3, 2e-3])
def test_what_rows_see_of_the_inductance_is_the_slope_of_what_they_show(period_s: float) -> None:
    R, L, step = VALUES["R"], VALUES["L"], 1e-4 * VALUES["L"]

    def shown(L: float) -> float:
        return L + R * period_s * (settling(R, L, period_s)[0] - 0.5)

    slope = (shown(L + step) - shown(L - step)) / (2.0 * step)
    assert settling(R, L, period_s)[1] == pytest.approx(slope, rel=1e-4, abs=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_doubt_grows_with_the_period_without_an_edge(name: str) -> None:
    rates = [1000.0 * 0.99**k for k in range(400)]  # 1000 to 18 Hz
    stds = [sampled_std(name, VALUES, 1.0 / rate) for rate in rates]
    steps = list(pairwise(stds))
    assert all(0.0 < a <= b for a, b in steps)
    assert all(b < 1.2 * a for a, b in steps if a < 1.0)  # beyond it nothing is known
