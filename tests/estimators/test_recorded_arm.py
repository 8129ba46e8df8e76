"""A real arm with a known load: its gains from the controller's log, and its load by them."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hil.data import Dataset
from hil.dynamics import load_model
from hil.estimators.drive_gains import controller_gains
from hil.estimators.payload import payload_halves
from hil.estimators.rigid_hysteresis import RigidHysteresis
from hil.estimators.rigid_linear import RigidWls
from hil.importers import import_recording
from hil.importers.sources import load_source
from tests.support.paths import EXPERIMENTS, ROOT

DATA = Path(os.environ.get("HIL_DATA", ROOT.parent / "shared" / "data"))
MAP = EXPERIMENTS / "maps" / "ur10e_columns.yaml"
TRAIN = ("10-30sec_12harm", "12-40sec_12harm", "12-50sec_12harm", "05-20sec_8harm")
TRUE_KG = 2.805

pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(
        not (DATA / "ur10e").is_dir(),
        reason="the recorded robot data are not here: set HIL_DATA to their folder",
    ),
]


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ur10e")

    def imported(name: str) -> Dataset:
        out = folder / f"{name}.mcap"
        if not out.exists():
            import_recording(DATA / "ur10e" / f"ur-20_02_{name}.csv", map_file=MAP, out=out)
        return load_source(out)

    return imported


def test_the_controller_uses_the_same_gains_with_a_load_and_without(recording) -> None:
    bare = controller_gains(recording("19_14harm50sec"))
    loaded = controller_gains(recording("19_14harm50secLoad"))
    assert bare.gain == pytest.approx([11.75, 11.99, 9.82, 10.68, 10.33, 10.9], rel=0.005)
    assert loaded.gain == pytest.approx(bare.gain, rel=0.005)
    assert np.all(bare.residual_share < 0.05)


def test_gains_of_several_days_come_with_a_note_about_the_joint_that_differs(recording) -> None:
    found = controller_gains(Dataset.concatenate([recording(name) for name in TRAIN]))
    assert found.determined.all()
    assert [note.partition(":")[0] for note in found.notes] == ["wrist_2_joint"]


@pytest.mark.thorough
def test_the_load_is_found_by_gains_that_do_not_know_it(recording) -> None:
    train = Dataset.concatenate([recording(name) for name in TRAIN])
    gained = replace(train, drive_gains=controller_gains(train).gain)
    loaded = recording("19_14harm50secLoad")
    for half in payload_halves(RigidWls().fit(gained, load_model("ur10e")), loaded):
        assert half.estimate.payload.mass == pytest.approx(TRUE_KG, rel=0.02)
        low, high = half.estimate.interval[0]
        assert low < TRUE_KG < high
        assert half.mean_raw < 0.175
        assert np.mean(half.rmse_ignored) > 0.65


@pytest.mark.thorough
def test_published_gains_make_it_too_heavy_and_no_residual_shows_it(recording) -> None:
    model = RigidWls().fit(recording("19_14harm50sec"), load_model("ur10e"))
    one, two = payload_halves(model, recording("19_14harm50secLoad"), friction="model")
    assert [one.mean_raw, two.mean_raw] == pytest.approx([0.1725, 0.1743], rel=0.01)
    assert one.estimate.payload.mass == pytest.approx(3.09, rel=0.01)
    assert two.estimate.payload.mass == pytest.approx(3.07, rel=0.01)


@pytest.mark.proof
def test_friction_with_memory_brings_the_loaded_arm_near_its_noise(recording) -> None:
    train = Dataset.concatenate([recording(name) for name in TRAIN])
    gained = replace(train, drive_gains=controller_gains(train).gain)
    model = RigidHysteresis().fit(gained, load_model("ur10e"))
    for half in payload_halves(model, recording("19_14harm50secLoad")):
        assert half.mean_raw <= 0.125
        assert half.estimate.payload.mass == pytest.approx(TRUE_KG, rel=0.05)
