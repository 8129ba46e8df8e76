"""A residual network on a network: all of its trainings are kept, those of its physics as well."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.support.residual_models import SHORT, SMOOTH, known, unfitted
from tests.support.synthetic_motion import nominal

pytest.importorskip("torch", reason="torch is not installed")

from hil.networks.residual_network import ResidualNetwork
from hil.networks.training import Told

QUICK = SHORT | {"epochs": 2, "batch_size": 400}
NETWORK = {
    "estimator": "lagrangian", "network": {"hidden": [8]}, "friction": "coulomb",
    "learning": "joint", "training": QUICK,
}  # fmt: skip
PHYSICS = ("physics", "fold-1", "fold-2")


def fitted(folder: Path | None, stop_at: int = 0) -> tuple[ResidualNetwork, int]:
    """The model, and how many epochs were trained for it."""
    told: list[Told] = []

    def watch(epoch: Told) -> None:
        told.append(epoch)
        if len(told) == stop_at:
            raise KeyboardInterrupt

    model = unfitted(base=NETWORK, training=QUICK)
    model.watch_, model.checkpoints_ = watch, folder
    return model.fit(known(), nominal()), len(told)


@pytest.mark.thorough
def test_a_fit_goes_on_where_the_training_of_its_physics_stood(tmp_path: Path) -> None:
    whole, epochs = fitted(None)
    assert epochs == 2 * len((*PHYSICS, "network-1", "network-2"))
    with pytest.raises(KeyboardInterrupt):
        fitted(tmp_path, stop_at=4)
    assert {one.name for one in tmp_path.iterdir()} == {"physics", "fold-1"}
    resumed, left = fitted(tmp_path)
    assert left == epochs - 3  # the epoch at work is trained again
    expected, found = whole.fitted_arrays(), resumed.fitted_arrays()
    assert all(np.array_equal(found[name], value) for name, value in expected.items())


def test_physics_that_trains_nothing_is_given_no_folder(tmp_path: Path) -> None:
    model = unfitted(base=SMOOTH, training=QUICK)
    model.checkpoints_ = tmp_path
    model.fit(known(), nominal())
    assert {one.name for one in tmp_path.iterdir()} == {"network-1", "network-2"}
