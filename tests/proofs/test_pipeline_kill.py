"""Killed more than sixty times at random points, a schedule comes to what it comes to undisturbed.

Its loop, the pipeline and the registry die together, as they would with their computer.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.support.pipeline_deaths import attempts, died, predicted, require_accounted, require_once

SEEDS = range(12)
LIVES = 30

pytestmark = [pytest.mark.proof, pytest.mark.timeout(3600)]


def test_everything_is_done_once_and_comes_to_the_same(tmp_path: Path) -> None:
    died(tmp_path / "whole", seed=0, lives=1)
    whole = require_once(tmp_path / "whole")
    expected = predicted(tmp_path / "whole", tmp_path / "whole")
    deaths, untouched = 0, 0
    for seed in SEEDS:
        folder = tmp_path / str(seed)
        deaths += died(folder, seed=seed, lives=LIVES) - 1
        told = require_once(folder)
        require_accounted(folder)
        assert told["outcome"] == whole["outcome"] == "promoted", told["text"]
        found = predicted(folder, tmp_path / "whole")
        if attempts(folder) == 1:
            assert np.array_equal(found, expected)
            untouched += 1
        else:  # the rest of the motion was measured by an arm that was switched on again
            assert np.max(np.abs(found - expected)) < 0.05 * np.std(expected)
    print(f"{deaths} deaths for {len(SEEDS)} occasions, {untouched} campaigns of one attempt")  # noqa: T201
    assert deaths > 60
    assert untouched
