"""Recordings and files that networks alone refuse; test_conformance.py has what all refuse."""

from __future__ import annotations

import hashlib
import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load, save

from hil.cli.app import main
from hil.core import plugins
from hil.core.errors import DataError, FitError, HilError, SpecError
from hil.data import Dataset
from hil.estimators import load_model_file, model_files
from hil.importers import import_recording
from hil.studies.base import study
from tests.support.every_estimator import LAGRANGIAN, fitted, kind_of, unfitted
from tests.support.fuzzing import quick_folder
from tests.support.imported_motions import layout, recording
from tests.support.synthetic_motion import moving, nominal, raw

pytest.importorskip("torch", reason="torch is not installed")

KINDS = ["lagrangian", "lagrangian memory", "residual"]
kinds = pytest.mark.parametrize("kind", KINDS)
on_motion = pytest.mark.parametrize("kind", [*KINDS, "residual on a network"])


def recorded(*seeds: int, **changed: Any) -> Dataset:
    """As recorded: nothing is filtered yet."""
    return raw(moving(*seeds, **changed))


def spoilt(data: Dataset, column: str, value: float) -> Dataset:
    values = np.array(data[column])
    values[(30, 2) if values.ndim == 2 else 30] = value
    return data.with_columns(**{column: values})


def scaled(data: Dataset, **by: float) -> Dataset:
    return data.with_columns(**{name: factor * data[name] for name, factor in by.items()})


def refusal(kind: str, data: Dataset) -> HilError:
    with pytest.raises((FitError, DataError)) as caught:
        unfitted(kind).fit(data, nominal())
    assert caught.value.hint
    return caught.value


# Recordings


@kinds
def test_a_velocity_that_is_none_is_told_by_row_and_joint(kind: str) -> None:
    for value in (np.nan, np.inf, -np.inf):
        message = refusal(kind, spoilt(recorded(1, 2), "qd", value)).message
        assert "1 values of qd are not finite, the first in row 31 joint 3" in message


@kinds
@pytest.mark.parametrize("column", ["q", "qd", "effort"])
def test_columns_that_are_too_large_in_any_unit_are_refused(kind: str, column: str) -> None:
    assert f"{column} of " in refusal(kind, scaled(recorded(1, 2), **{column: 1e200})).message


@kinds
@pytest.mark.parametrize("how", ["twice", "shuffled", "backwards", "standing"])
def test_time_that_does_not_increase_is_told_with_its_series(kind: str, how: str) -> None:
    data = recorded(1, 2)
    t = data["t"].copy()
    first = slice(0, int(data.offsets[1]))
    if how == "twice":
        t[31] = t[30]
    elif how == "shuffled":
        t[first] = np.random.default_rng(0).permutation(t[first])
    else:
        t[first] = -t[first] if how == "backwards" else 1.0
    message = refusal(kind, data.with_columns(t=t)).message
    assert re.search("series trajectory1: .*strictly increasing", message)


@kinds
def test_stamps_that_are_no_seconds_are_told_by_their_rate(kind: str) -> None:
    assert "sample rate of 1e+11 Hz" in refusal(kind, scaled(recorded(1, 2), t=1e-9)).message


def test_rows_that_come_a_minute_apart_are_no_motion_to_the_usual_physics() -> None:
    data = scaled(recorded(1, 2), t=1e5)
    with pytest.raises(DataError, match=r"rate of .* is too low") as caught:
        unfitted("residual").set_params(base={"estimator": "rigid-hysteresis"}).fit(data, nominal())
    assert "seconds" in caught.value.hint


@pytest.mark.thorough
def test_rates_that_differ_matter_to_what_counts_samples_alone() -> None:
    data = Dataset.concatenate([recorded(1, 2), scaled(recorded(3), t=2.0)])
    assert "trajectory3 is sampled at 50 Hz" in refusal("residual", data).message
    assert np.all(np.isfinite(unfitted("lagrangian").fit(data, nominal()).sigma_))


@pytest.mark.thorough
@kinds
@pytest.mark.parametrize("lacks", ["trajectories", "velocity"])
def test_one_trajectory_and_no_velocity_are_enough(kind: str, lacks: str) -> None:
    data = recorded(1) if lacks == "trajectories" else recorded(1, 2)
    columns = {name: v for name, v in data.columns.items() if lacks != name != "qd"}
    model = unfitted(kind).fit(replace(data, columns=columns), nominal())
    assert np.all(np.isfinite(model.predict(recorded(9)).effort))


@pytest.mark.thorough
@kinds
@pytest.mark.parametrize("column", ["t", "q", "qd", "effort"])
def test_a_prediction_is_not_made_of_what_is_none(kind: str, column: str) -> None:
    with pytest.raises(DataError, match="series trajectory9: ") as caught:
        fitted(kind).predict(spoilt(recorded(9), column, np.nan))
    assert caught.value.hint


@on_motion
def test_another_rate_is_refused_by_what_counts_samples_alone(kind: str) -> None:
    slow = scaled(moving(9), t=3.0)
    if kind.startswith("residual"):
        with pytest.raises(DataError, match="trained at 100 Hz"):
            fitted(kind).predict(slow)
    else:
        assert np.all(np.isfinite(fitted(kind).predict(slow).effort))


def test_positions_of_another_width_have_no_mass_matrix() -> None:
    for q in (np.zeros((3, 5)), np.zeros(6)):
        with pytest.raises(DataError, match=r"must be \(N, 6\)"):
            fitted("lagrangian").mass_matrix(q)
    assert fitted("lagrangian").mass_matrix(np.zeros((0, 6))).shape == (0, 6, 6)


@pytest.mark.thorough
def test_a_rate_of_the_friction_does_nothing_where_there_is_none() -> None:
    training = LAGRANGIAN["training"] | {"group_rates": {"friction": 2.0, "dynamics": 0.5}}
    model = kind_of("lagrangian")(**{**LAGRANGIAN, "training": training, "friction": "none"})
    assert model.fit(moving(1, 2), nominal()).samples_ > 0


# Files


def refused_file(kind: str, document: dict[str, Any], arrays: bytes) -> DataError:
    document["arrays_sha256"] = hashlib.sha256(arrays).hexdigest()
    with quick_folder() as folder:
        (folder / "model.json").write_text(json.dumps(document))
        (folder / "model.safetensors").write_bytes(arrays)
        with pytest.raises(DataError, match=r"/model\.") as caught:
            load_model_file(folder)
    assert caught.value.hint
    return caught.value


def of_file(kind: str) -> tuple[dict[str, Any], bytes]:
    files = model_files(fitted(kind))
    return json.loads(files["model.json"]), files["model.safetensors"]


@pytest.mark.parametrize(
    ("kind", "name", "change"),
    [
        ("lagrangian dissipative", "network.friction.places", lambda places: places + 30),
        ("lagrangian dissipative", "network.friction.places", lambda places: -places),
        ("lagrangian memory", "length", lambda length: np.full_like(length, 0.0)),
        ("lagrangian memory", "length", lambda length: np.full_like(length, -1.0)),
        ("lagrangian memory", "length", lambda length: np.full_like(length, np.inf)),
    ],
)
def test_arrays_that_the_design_rules_out_are_refused_by_name(kind, name, change) -> None:
    document, content = of_file(kind)
    arrays = load(content)
    broken = save(arrays | {name: np.ascontiguousarray(change(arrays[name]))})
    assert name.rpartition(".")[2] in refused_file(kind, document, broken).message


@pytest.mark.parametrize(
    ("kind", "way", "to"),
    [
        ("lagrangian", ("design", "network", "hidden"), [4096] * 16),
        ("lagrangian", ("design", "network", "hidden"), [10**12, 10**12]),
        ("lagrangian dissipative", ("design", "friction", "hidden"), [10**9, 10**9]),
        ("lagrangian dissipative", ("design", "friction", "hidden"), [4096] * 4096),
        ("lagrangian dissipative", ("design", "friction", "rest_speed"), 10**400),
        ("residual", ("networks",), 10**9),
        ("residual", ("networks",), 1e308),
        ("residual", ("residual", "dilations"), [10**9, 4]),
        ("residual", ("residual", "dilations"), [1, 1e308]),
        ("residual", ("residual", "kernel"), 10**12),
        ("residual", ("residual", "channels"), 10**12),
        ("residual", ("residual", "latency_s"), 1e300),
        (
            "residual on a network",
            ("base", "fitted", "design", "network", "hidden"),
            [4096] * 16,
        ),
    ],
)
def test_absurd_sizes_are_refused_before_they_take_up_memory(kind, way, to, monkeypatch) -> None:
    def enormous(*args: object, **kwargs: object) -> None:
        raise AssertionError("a network was built")

    document, arrays = of_file(kind)
    at = document["fitted"]
    for key in way[:-1]:
        at = at[key]
    at[way[-1]] = to
    monkeypatch.setattr("hil.networks.lagrangian.NetworkModel", enormous)
    refused_file(kind, document, arrays)


# The study of inverse dynamics, and the command line

STUDY = plugins.load("hil.studies", "inverse-dynamics").parameter_names()
OF_NO_USE = [
    float("nan"), float("inf"), -1, 10**400, b"x", [[1]], {1: 2}, {"a": 1}, ["x", None], object(),
    1 + 2j, "nowhere",
]  # fmt: skip
"""What no parameter can be."""


@pytest.mark.thorough
@pytest.mark.parametrize("parameter", STUDY)
def test_a_parameter_of_the_study_is_refused_by_its_name(parameter: str) -> None:
    for value in OF_NO_USE:
        with pytest.raises(SpecError, match=f"^inverse-dynamics: {parameter}"):
            study("inverse-dynamics", **{parameter: value})


@pytest.mark.parametrize("given", [{"seeds": 10**9}, {"jobs": 10**9}, {"effort": 1e300}])
def test_a_study_without_end_is_refused_at_once(given: dict[str, Any]) -> None:
    with pytest.raises(SpecError, match="at most"):
        study("inverse-dynamics", **given)


def exit_code(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> object:
    """What `hil` ends with."""
    monkeypatch.setattr(sys, "argv", ["hil", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code


@pytest.mark.thorough
def test_the_command_line_ends_with_the_documented_codes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    good, torn = recording(tmp_path, 1), tmp_path / "torn.mcap"
    torn.write_bytes(good.read_bytes()[:300])
    rows = np.loadtxt(tmp_path / "1.csv", delimiter=",")
    rows[:, 1:7] = 0.3
    np.savetxt(tmp_path / "still.csv", rows, delimiter=",")
    still = tmp_path / "still.mcap"
    import_recording(tmp_path / "still.csv", map_file=layout(), out=still)
    for name in ("lagrangian", "residual"):
        asked = ("--estimator", name, "--out", tmp_path / "models")
        assert exit_code(monkeypatch, "fit", good, *asked, "--set", "seed=-1") == 2
        assert exit_code(monkeypatch, "fit", torn, *asked) == 8
        assert exit_code(monkeypatch, "fit", still, *asked) == 9
    series = tmp_path / "series.yaml"
    series.write_text("hil_series: 1\nname: a\nseries: [{spec: nowhere.yaml}]\n")
    assert exit_code(monkeypatch, "run", series) == 2
    assert exit_code(monkeypatch, "study", tmp_path, "--study", "inverse-dynamics") == 8
