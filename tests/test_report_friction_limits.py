"""Friction on the page of a model: what it must not say or draw."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_motion import moving, nominal

from hil.identify.rigid import RigidWls
from hil.identify.rigid_irls import RigidIrls
from hil.identify.rigid_methods import RigidLeastSquares
from hil.report import friction_plots
from hil.report.predictions import Shown, shown

VELOCITIES = np.linspace(-1.5, 1.5, 31)[:, None] * np.ones(6)


@pytest.fixture(scope="module")
def wls() -> RigidWls:
    return RigidWls().fit(moving(1, 2, 3, noise_a=0.05), nominal())


@pytest.fixture(scope="module")
def seen(wls: RigidWls) -> Shown:
    return shown(wls, moving(4, noise_a=0.05))


@pytest.mark.parametrize(
    ("model", "holds"),
    [
        (RigidLeastSquares(), True),
        (RigidIrls(exponent=False, feasible=False), True),
        (RigidIrls(exponent=True, feasible=False), False),
    ],
    ids=["wls", "irls", "irls-exponent"],
)
def test_no_band_where_the_standard_errors_of_least_squares_are_not_the_methods(
    model, holds: bool
) -> None:
    model.fit(moving(1, 2, 3, noise_a=0.05), nominal())
    assert np.isfinite(model.friction_curve(VELOCITIES).std_error).all() == holds
    motion = shown(model, moving(4, noise_a=0.05)).friction.in_motion
    names = [trace["name"] for trace in friction_plots.moving(motion, 0, "N·m")["data"]]
    assert ("± 2 standard errors, at most" in names) == holds
