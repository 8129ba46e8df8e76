"""`hil bench predict` runs, and what it times says what the model says."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec

import pytest

from hil.cli.bench import measure
from hil.core.errors import FitError
from hil.export.c_compiler import compiler
from tests.support.paths import ROOT

pytest.importorskip("torch", reason="torch is not installed")

C, OWN = ("portable", "native"), ("compiled", "python")
PEERS = ("onnxruntime", "onnxruntime_bound", "torch")
ONNX = all(find_spec(library) is not None for library in ("onnx", "onnxscript", "onnxruntime"))


@pytest.mark.proof
@pytest.mark.skipif(compiler() is None, reason="there is no C compiler")
def test_every_contestant_is_timed_and_agrees() -> None:
    document = measure("predict", quick=True)
    figures, skipped = document["figures"], document["skipped"]
    for name in ("memory", "network"):
        there = [how for how in PEERS if f"{name}_{how}" not in skipped]
        assert "torch" in there
        ort = {"onnxruntime", "onnxruntime_bound"} & figures_of(name, figures)
        assert len(ort) == (2 if name == "memory" and ONNX else 0)
        there = [how for how in there if how == "torch" or how in ort]
        for how in (*C, "compiled", "python", *there):
            p50, p99 = (figures[f"{name}_{how}_{p}_ns"] for p in ("p50", "p99"))
            assert 0 < p50 <= p99 <= figures[f"{name}_{how}_max_ns"]
            assert document["flags"][how]
        assert all(figures[f"{name}_{how}_off_by"] < 1e-4 for how in (*C, *there, *OWN))
        assert "left out of --quick" in skipped[f"{name}_torch_compiled"]
        assert document["ratios"][f"{name}_torch_over_c"] > 0
    # Single precision shows: a network that says nothing would agree as well as physics does.
    assert figures["network_portable_off_by"] > 100 * figures["memory_portable_off_by"]
    assert "-march=native" in document["flags"]["native"]
    # Who only looks through hil at Pinocchio pays for hil.
    assert document["ratios"]["pinocchio_through_hil_over_c"] > 1.0
    assert figures["pinocchio_rnea_p50_ns"] < figures["pinocchio_through_hil_p50_ns"]


def figures_of(name: str, figures: dict[str, float]) -> set[str]:
    return {key[len(name) + 1 : -7] for key in figures if key.startswith(name) and "_p50_" in key}


@pytest.mark.parametrize("off", [{}, {"c_off_by": 2e-4}, {"c_off_by": float("nan")}])
def test_who_is_timed_without_agreement_makes_it_fail(off: dict[str, float], monkeypatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    require_agreement = import_module("benchmarks.prediction.agreement").require_agreement
    require_agreement({"c_p50_ns": 1.0, "c_off_by": 1e-5})
    with pytest.raises(FitError, match="c was timed, but is off the model by"):
        require_agreement({"c_p50_ns": 1.0, **off})
