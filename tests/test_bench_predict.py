"""`hil bench predict` runs, and what it times says what the model says."""

from __future__ import annotations

import pytest

from hil.benchmarking import measure
from hil.deploy.export.c_build import compiler

pytest.importorskip("torch", reason="torch is not installed")


@pytest.mark.skipif(compiler() is None, reason="there is no C compiler")
def test_every_contestant_is_timed_and_agrees() -> None:
    document = measure("predict", quick=True)
    figures = document["figures"]
    for name in ("memory", "network"):
        assert figures[f"{name}_off_by"] < 1e-4
        for how in ("portable", "native", "compiled", "python"):
            p50, p99 = (figures[f"{name}_{how}_{p}_ns"] for p in ("p50", "p99"))
            assert 0 < p50 <= p99 <= figures[f"{name}_{how}_max_ns"]
    assert all(ratio > 0 for ratio in document["ratios"].values())
