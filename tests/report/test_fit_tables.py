"""Tables of a model say what its numbers do not mean."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.report.model_sections import per_group, per_joint


def fit_with(*nrmse: float) -> Any:
    """A model with such NRMSE on its training data; everything else is 0.1."""
    names = tuple(f"joint_{j}" for j in range(len(nrmse)))

    def values(metric: str, of: str = "held_out") -> Any:
        return np.array(nrmse if (metric, of) == ("nrmse", "trained") else [0.1] * len(nrmse))

    return SimpleNamespace(
        label="wls", unit="A", fast_part="noise", criteria=[], joint_names=names,
        values=values, mean=lambda metric, of="held_out": 0.1,
    )  # fmt: skip


@pytest.mark.parametrize(("nrmse", "named"), [((0.1, 0.99), "joint_1"), ((0.1, 0.2), "")])
def test_an_nrmse_of_1_is_explained_where_a_joint_is_hardly_loaded(
    nrmse: tuple[float, ...], named: str
) -> None:
    note = per_joint(fit_with(*nrmse)).note
    assert note.startswith(f"An NRMSE near 1 is no fault of the model at {named}:") is bool(named)


@pytest.mark.parametrize(("count", "said"), [(2, True), (1, False)])
def test_how_trajectories_are_counted_is_said_where_several_are_listed(
    count: int, said: bool
) -> None:
    fit = fit_with(0.1)
    named = [("trajectory", f"run#{n}") for n in range(count)] + [("kind", "a"), ("kind", "b")]
    fit.held_out = {"tables": [{"by": by, "name": name, "samples": 9} for by, name in named]}
    table = per_group(fit)
    assert table is not None
    assert ("counted from 0" in table.note) is said
