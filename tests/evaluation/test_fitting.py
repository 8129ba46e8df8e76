"""From recordings to a stored, validated model: what `hil fit` does."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

import hil
from hil.arms.payload import Payload, parse_payload
from hil.core.errors import DataError, FitError, PluginError, SpecError
from hil.estimators.rigid_linear import RigidWls
from hil.importers.sources import load_source
from tests.support.imported_motions import recording
from tests.support.synthetic_motion import LOAD


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sources")
    return [recording(folder, seed) for seed in (1, 2, 9)]


@pytest.fixture(scope="module")
def fitted(sources, tmp_path_factory):
    """The report of a fit to two recordings, judged on the third; its folder is not changed."""
    models = tmp_path_factory.mktemp("models")
    return hil.fit(sources[:2], estimator="rigid-wls", validate=sources[2:], out=models)


def test_report_has_the_keys_of_the_contract_and_the_model_is_stored(sources, fitted) -> None:
    report = fitted.to_dict()
    assert set(report) == {"model", "estimator", "seconds", "validation"}
    assert report["estimator"] == "rigid-wls"
    (entry,) = report["validation"]
    assert {"source", "unit", "rmse_raw", "rmse_filtered", "mean_raw", "mean_filtered"} <= set(
        entry
    )
    assert entry["source"] == str(sources[2])
    assert entry["unit"] == "A"
    assert entry["mean_raw"] == pytest.approx(np.mean(entry["rmse_raw"]))
    assert entry["mean_raw"] < 0.05
    folder = fitted.fitted.folder
    assert str(folder) == report["model"]
    assert {f.name for f in folder.iterdir()} == {
        "model.json",
        "model.safetensors",
        "evaluation.json",
    }
    json.dumps(report, allow_nan=False)


def test_stored_model_is_judged_again_to_the_same_numbers(sources, fitted) -> None:
    (again,) = hil.evaluate(fitted.fitted.folder, sources[2:])
    (first,) = fitted.to_dict()["validation"]
    assert again["rmse_raw"] == first["rmse_raw"]
    assert again["nrmse"] == first["nrmse"]
    effort = np.concatenate([load_source(path)["effort"] for path in sources[:2]])
    assert again["nrmse"] == pytest.approx(again["rmse_raw"] / np.std(effort, axis=0))


@pytest.mark.thorough
def test_judging_a_model_on_its_training_data_is_refused(sources, fitted, tmp_path) -> None:
    copy = recording(tmp_path, 1, name="copy", late_s=100.0)
    for source in (sources[1], copy):
        with pytest.raises(
            DataError, match="about 100 % of its samples are training data"
        ) as caught:
            hil.evaluate(fitted.fitted.folder, [sources[2], source])
        assert "1.mcap, 2.mcap" in caught.value.message
        assert "did not use" in caught.value.hint


@pytest.mark.thorough
def test_models_of_an_older_hil_are_judged_though_they_do_not_know_their_training(
    sources, fitted, tmp_path
) -> None:
    folder = shutil.copytree(fitted.fitted.folder, tmp_path / "model")
    document = json.loads((folder / "model.json").read_text("utf-8"))
    del document["training"], document["fitted"]["std_error"]
    (folder / "model.json").write_text(json.dumps(document), "utf-8")
    assert len(hil.evaluate(folder, sources)) == 3


def test_copy_with_its_clock_shifted_is_found(sources, tmp_path) -> None:
    copy = recording(tmp_path, 1, name="later", late_s=17.0)
    with pytest.raises(DataError, match="samples of the test data are also in the training"):
        hil.fit(sources, estimator="rigid-wls", validate=[copy], out=tmp_path / "models")


@pytest.mark.thorough
def test_evaluations_of_a_model_are_kept(sources, tmp_path) -> None:
    def fit(*validate):
        report = hil.fit(sources[:2], estimator="rigid-wls", validate=validate, out=tmp_path)
        path = report.fitted.folder / "evaluation.json"
        return json.loads(path.read_text("utf-8"))["validation"] if path.exists() else None

    other = recording(tmp_path, 10, name="other")
    assert fit() is None
    (first,) = fit(sources[2])
    assert fit() == [first]
    both = fit(other)
    assert both[0] == first
    assert [entry["source"] for entry in both] == [str(sources[2]), str(other)]
    assert sorted(map(str, fit(sources[2]))) == sorted(map(str, both))


@pytest.mark.thorough
def test_damaged_evaluation_is_refused_rather_than_lost(sources, tmp_path) -> None:
    folder = hil.fit(sources[:2], estimator="rigid-wls", out=tmp_path).fitted.folder
    (folder / "evaluation.json").write_text("[1]")
    with pytest.raises(DataError, match="is not a valid evaluation"):
        hil.fit(sources[:2], estimator="rigid-wls", validate=sources[2:], out=tmp_path)
    assert (folder / "evaluation.json").read_text() == "[1]"


def test_an_estimator_whose_fit_sets_nothing_is_named(sources, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(RigidWls, "fit", lambda self, dataset, robot: self)
    with pytest.raises(PluginError, match=r"fit\(\) of .*RigidWls.* does not set robot_"):
        hil.fit(sources[0], estimator="rigid-wls", out=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_two_individuals_of_a_robot_are_not_pooled(sources, tmp_path) -> None:
    a, b = (recording(tmp_path, seed, serial=f"SN{seed}") for seed in (11, 12))
    with pytest.raises(
        FitError, match=r"2 different robots, by serial number: SN11 \(11.mcap\)"
    ) as no:
        hil.fit([a, b], estimator="rigid-wls", out=tmp_path / "models")
    assert "--validate" in no.value.hint
    hil.fit([a, sources[0]], estimator="rigid-wls", out=tmp_path / "models")


@pytest.mark.thorough
def test_judging_on_another_individual_is_noted(tmp_path) -> None:
    a, b = (recording(tmp_path, seed, serial=f"SN{seed}") for seed in (11, 12))
    report = hil.fit([a], estimator="rigid-wls", validate=[b], out=tmp_path / "models")
    (note,) = report.validation[0].notes
    assert note == "recorded on another robot (serial SN12) than the training data (SN11)"
    (entry,) = hil.evaluate(report.fitted.folder, [b])
    assert entry["notes"] == [note]


@pytest.mark.thorough
def test_same_program_on_another_arm_is_noted_but_judged(sources, tmp_path) -> None:
    again = recording(tmp_path, 1, name="again", load=LOAD)
    report = hil.fit(
        sources[:2], estimator="rigid-wls", validate=[again, sources[2]], out=tmp_path / "models"
    )
    same, new = report.validation
    (note,) = same.notes
    assert "1 of 1 series pass through poses of the training data" in note
    assert new.notes == ()


@pytest.mark.thorough
def test_python_api_takes_one_path_or_several(sources, tmp_path) -> None:
    one = hil.fit(
        str(sources[0]), estimator="rigid-wls", validate=str(sources[2]), out=tmp_path
    ).to_dict()
    several = hil.fit(sources[:1], estimator="rigid-wls", validate=sources[2:], out=tmp_path)
    assert one["validation"] == several.to_dict()["validation"]
    assert hil.evaluate(one["model"], sources[2]) == hil.evaluate(one["model"], sources[2:])


def test_equal_fits_share_a_folder_and_different_ones_do_not(sources, tmp_path) -> None:
    for width in (0.01, 0.01, 0.02):
        hil.fit(sources[:2], estimator="rigid-wls", out=tmp_path, parameters={"sign_width": width})
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.thorough
def test_declared_payload_overrides_what_the_recordings_say(sources, tmp_path) -> None:
    loaded = [recording(tmp_path, seed, load=LOAD) for seed in (11, 12)]

    def error(payload):
        report = hil.fit(
            loaded,
            estimator="rigid-wls",
            payload=payload,
            validate=sources[:1],
            out=tmp_path / "models",
        )
        return report.to_dict()["validation"][0]["mean_raw"]

    assert error(LOAD) < 0.1 * error(None)


def test_validating_on_training_data_is_refused(sources, tmp_path) -> None:
    with pytest.raises(DataError, match="both training and test"):
        hil.fit(sources, estimator="rigid-wls", validate=sources[:1], out=tmp_path)


def test_training_data_under_another_name_are_found(sources, tmp_path) -> None:
    copy = recording(tmp_path, 1, name="copy")
    with pytest.raises(DataError, match="samples of the test data are also in the training"):
        hil.fit(sources, estimator="rigid-wls", validate=[copy], out=tmp_path / "models")


def test_mixed_robots_and_units_are_refused(sources, tmp_path) -> None:
    other = recording(tmp_path, 5, name="other", robot="ur10e")
    with pytest.raises(FitError, match="robot is 'ur5' in one source and 'ur10e'"):
        hil.fit([*sources, other], estimator="rigid-wls", out=tmp_path)
    torque = recording(tmp_path, 6, name="torque", effort_kind="torque")
    with pytest.raises(FitError, match=r"a current \[A\], the validation data a torque"):
        hil.fit(sources, estimator="rigid-wls", validate=[torque], out=tmp_path)


def test_slips_are_found_before_any_data_are_read(tmp_path) -> None:
    nowhere = [tmp_path / "nowhere.mcap"]
    with pytest.raises(PluginError):
        hil.fit(nowhere, estimator="rigid", out=tmp_path)
    with pytest.raises(SpecError, match="no parameter 'width'"):
        hil.fit(nowhere, estimator="rigid-wls", out=tmp_path, parameters={"width": 3})


def test_robot_label_without_a_model_asks_for_one(tmp_path) -> None:
    labelled = recording(tmp_path, 1, robot="our-arm")
    with pytest.raises(SpecError, match="no built-in arm 'our-arm'"):
        hil.fit([labelled], estimator="rigid-wls", out=tmp_path)
    report = hil.fit([labelled], estimator="rigid-wls", robot="ur5", out=tmp_path / "models")
    assert report.fitted.model.robot_.name == "ur5"


@pytest.mark.parametrize(
    ("text", "payload"),
    [("2.8", Payload(2.8)), ("2.8,0,0,0.05", Payload(2.8, (0.0, 0.0, 0.05)))],
)
def test_payload_as_typed(text, payload) -> None:
    assert parse_payload(text) == payload


@pytest.mark.parametrize("text", ["", "x", "1,2", "-1", "1,2,3,nan"])
def test_payload_that_cannot_be_is_refused(text) -> None:
    with pytest.raises(SpecError, match="neither MASS nor"):
        parse_payload(text)


@pytest.mark.thorough
def test_a_validation_with_another_load_is_judged_three_ways_and_its_load_checked(
    sources, tmp_path
) -> None:
    declared = {"mass_kg": LOAD.mass, "com_m": LOAD.com, "inertia_kgm2": LOAD.inertia}
    loaded = recording(tmp_path, 9, load=LOAD, name="loaded", payload=declared)
    report = hil.fit(
        sources[:2], estimator="rigid-wls", validate=[sources[2], loaded], out=tmp_path / "models"
    ).to_dict()
    bare, under = report["validation"]
    assert bare["under_load"] is None
    found = under["under_load"]
    error = {told: np.mean(rmse) for told, rmse in found["rmse"].items()}
    assert error["declared"] == pytest.approx(under["mean_filtered"])
    assert error["identified"] < 0.2 * error["unaware"]
    assert found["identified"]["mass_kg"] == pytest.approx(LOAD.mass, rel=0.02)
    assert found["agrees"]
    (kept,) = (tmp_path / "models").glob("*/evaluation.json")
    assert json.loads(kept.read_text("utf-8"))["validation"][1]["under_load"] == found
    (again,) = hil.evaluate(kept.parent, [loaded])
    assert again["under_load"] == found
