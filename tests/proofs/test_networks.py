"""Ours and the PINN paper's methods on mock robots that nobody looked at during development."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.support.paths import ROOT

pytestmark = [pytest.mark.proof, pytest.mark.timeout(3600)]

JUDGED = (401, 402, 403)
"""Seeds never used to develop or tune anything; development looks at seeds 1 to 9."""


@pytest.fixture(scope="module")
def contests() -> Iterator[Any]:
    pytest.importorskip("torch", reason="torch is not installed")
    sys.path.insert(0, str(ROOT))
    from benchmarks.identification import networks_mock

    found = networks_mock.contests(JUDGED)
    for one in found:  # for people: `make proof` runs with -s
        told = {key: round(one.error(key), 4) for key in one.told}
        print(f"robot {one.seed}, N·m", told, "noise", round(one.oracle, 4))  # noqa: T201
    yield found
    sys.path.remove(str(ROOT))
    for name in [name for name in sys.modules if name.startswith("benchmarks")]:
        del sys.modules[name]


def test_every_method_is_finite_and_a_network_without_friction_is_the_worst(contests: Any) -> None:
    for one in contests:
        errors = {key: one.error(key) for key in one.told}
        assert np.all(np.isfinite(list(errors.values()))), errors
        assert max(errors, key=errors.__getitem__) == "delan"


def test_residual_compensation_without_torque_takes_a_quarter_off_the_proposed_method(
    contests: Any,
) -> None:
    for one in contests:
        assert one.error("rc-grouped") <= 0.75 * one.error("proposed")


@pytest.mark.parametrize("key", ["ours", "ours-residual"])
def test_ours_is_55_percent_below_the_best_known_method(contests: Any, key: str) -> None:
    for one in contests:
        assert one.left(key) <= 0.45
        assert one.gap_left(key) <= 0.40
