"""A hand that leads arms the filter was not chosen on: at most half of the effort, and rest."""

from __future__ import annotations

import numpy as np
import pytest

import hil
from hil.control import try_out
from hil.control.try_out import judged, relief
from hil.control.try_out_settings import HALF
from tests.support.trial_parts import of_arm

pytestmark = pytest.mark.proof


@pytest.mark.parametrize("seed", [11, 12, 13])
@pytest.mark.parametrize("arm", ["ur5", "lab6"])
def test_compensation_halves_the_effort_of_the_hand(tmp_path, arm, seed) -> None:
    station = tmp_path / "station.yaml"
    station.write_text(
        "hil_station: 1\nrobots:\n"
        f"  arm: {{driver: mock, model: {arm}, options: {{seed: {seed}}}}}\n"
    )
    folder = of_arm(arm, seed).save(tmp_path / "model")
    trial = hil.simulate(folder, tmp_path / "out", station=station, robot="arm")
    assert [criterion.name for criterion in judged(trial) if not criterion.met] == []
    for over in (try_out.NOTHING, try_out.DATASHEET, try_out.GRAVITY):
        assert np.all(relief(trial, try_out.FRICTION, over) <= HALF)
