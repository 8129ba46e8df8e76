"""`hil bench predict` runs, and what it times says what the model says."""

from __future__ import annotations

from importlib.util import find_spec

import pytest

from hil.benchmarking import measure
from hil.deploy.export.c_build import compiler

pytest.importorskip("torch", reason="torch is not installed")

C = ("portable", "native")
PEERS = ("onnxruntime", "torch")
ONNX = all(find_spec(library) is not None for library in ("onnx", "onnxscript", "onnxruntime"))


@pytest.mark.skipif(compiler() is None, reason="there is no C compiler")
def test_every_contestant_is_timed_and_agrees() -> None:
    document = measure("predict", quick=True)
    figures, skipped = document["figures"], document["skipped"]
    for name in ("memory", "network"):
        there = [how for how in PEERS if f"{name}_{how}" not in skipped]
        assert "torch" in there
        assert ("onnxruntime" in there) == (name == "memory" and ONNX)
        for how in (*C, "compiled", "python", *there):
            p50, p99 = (figures[f"{name}_{how}_{p}_ns"] for p in ("p50", "p99"))
            assert 0 < p50 <= p99 <= figures[f"{name}_{how}_max_ns"]
            assert document["flags"][how]
        assert all(figures[f"{name}_{how}_off_by"] < 1e-4 for how in (*C, *there))
        assert "left out of --quick" in skipped[f"{name}_torch_compiled"]
        assert document["ratios"][f"{name}_torch_over_c"] > 0
    # Single precision shows: a network that says nothing would agree as well as physics does.
    assert figures["network_portable_off_by"] > 100 * figures["memory_portable_off_by"]
    assert "-march=native" in document["flags"]["native"]
