"""A hundred robots fitted on local processes and on Dask, with a worker killed: the same bits."""

from __future__ import annotations

import pytest

from hil.cli.bench import measure


@pytest.mark.proof
@pytest.mark.timeout(1800)
def test_models_are_the_same_wherever_they_are_fitted_and_none_is_lost() -> None:
    pytest.importorskip("distributed", reason="distributed is not installed")
    figures = measure("fleet")["figures"]
    assert figures["robots"] == 100
    assert figures["workers_killed"] == 2
    assert figures["models_compared"] == 2 * 6 * 100
    assert figures["models_that_differ"] == figures["models_lost"] == 0
