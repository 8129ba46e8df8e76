"""`hil bench startup` measures what it says, each start beside an empty Python of the same run."""

from __future__ import annotations

import pytest

from hil.cli.bench import measure


@pytest.mark.proof
def test_every_start_is_measured_beside_an_empty_python() -> None:
    document = measure("startup", quick=True)
    figures, ratios = document["figures"], document["ratios"]
    for name in ("import_hil", "hil_version", "hil_help", "completion"):
        for peer in ("python", "import_numpy"):  # which is quicker, three starts do not show
            ratio = figures[f"{name}_ms"] / figures[f"{peer}_ms"]
            assert ratios[f"{name}_vs_{peer}"] == pytest.approx(ratio)
    assert min(figures.values()) > 1.0, figures
