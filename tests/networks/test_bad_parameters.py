"""Parameters of networks and of the study of inverse dynamics: a SpecError by name, or accepted."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.cli.app import main
from hil.core import plugins
from hil.core.errors import SpecError
from hil.estimators import estimator
from hil.estimators.parameters import settings
from hil.importers import import_recording
from hil.networks.lagrangian_settings import NetworkSettings
from hil.networks.training import TrainingSettings
from hil.studies.base import study
from tests.estimators.test_sources import layout, recording
from tests.support.bad_networks import LAGRANGIAN
from tests.support.synthetic_motion import moving, nominal

OF_NO_USE = [
    float("nan"), float("inf"), -1, 10**400, b"x", [[1]], {1: 2}, {"a": 1}, ["x", None], object(),
    1 + 2j, "nowhere",
]  # fmt: skip
"""What no parameter can be."""

NAMES = [
    (name, parameter)
    for name in ("lagrangian", "residual")
    for parameter in plugins.load("hil.estimators", name).parameter_names()
]
STUDY = plugins.load("hil.studies", "inverse-dynamics").parameter_names()


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "parameter"), NAMES)
def test_a_parameter_that_cannot_be_is_refused_by_its_name(name: str, parameter: str) -> None:
    for value in OF_NO_USE:
        with pytest.raises(SpecError, match=rf"^{name}: {parameter}\b"):
            estimator(name, **{parameter: value})


@pytest.mark.thorough
@pytest.mark.parametrize("parameter", STUDY)
def test_a_parameter_of_the_study_is_refused_by_its_name(parameter: str) -> None:
    for value in OF_NO_USE:
        with pytest.raises(SpecError, match=f"^inverse-dynamics: {parameter}"):
            study("inverse-dynamics", **{parameter: value})


@pytest.mark.parametrize(
    ("name", "given", "where", "meant"),
    [
        ("lagrangian", {"training": {"epoch": 5}}, "training", "epochs"),
        ("residual", {"training": {"epoch": 5}}, "training", "epochs"),
        ("lagrangian", {"network": {"hiden": [8]}}, "network", "hidden"),
        ("lagrangian", {"filters": {"ordr": 5}}, "filters", "order"),
    ],
)
def test_a_slip_inside_settings_is_answered_with_what_was_meant_and_what_there_is(
    name: str, given: dict[str, Any], where: str, meant: str
) -> None:
    (slip,) = given[where]
    told = f"^{name}: {where} has no parameter '{slip}' \\(it has .*\\b{meant}\\b"
    with pytest.raises(SpecError, match=told) as caught:
        estimator(name, **given)
    assert caught.value.hint == f"did you mean '{meant}'?"


@pytest.mark.parametrize(("coverage", "hint"), [(90, "0.9,"), (2.5, "0.025,"), (1, "0.5 is half")])
def test_a_share_in_percent_is_answered_with_the_share(coverage: float, hint: str) -> None:
    with pytest.raises(SpecError, match="coverage") as caught:
        estimator("residual", coverage=coverage)
    assert caught.value.hint.startswith(hint)


@pytest.mark.parametrize(
    "given",
    [
        {"seed": 10**30}, {"loops": 10**9}, {"network": 0}, {"network": []}, {"training": ""},
        {"network": {"hidden": [True]}}, {"network": {"scaled": 0}},
        {"network": {"hidden": [5000]}},
        {"training": {"epochs": True}}, {"training": {"epochs": "5"}},
        {"training": {"epochs": 2.5}},
        {"training": {"batch_size": 10**30}}, {"training": {"threads": 10**9}},
        {"training": {"seed": 10**30}}, {"training": {"loops": 10**9}},
    ],
)  # fmt: skip
def test_a_value_that_no_training_could_take_is_refused_at_once(given: dict[str, Any]) -> None:
    with pytest.raises(SpecError, match=next(iter(given))):
        estimator("lagrangian", **given)


@pytest.mark.parametrize(
    "network",
    [
        {"dilations": [10**9]}, {"dilations": [1, 2.5]}, {"kernel": 10**6}, {"crop": 10**9},
        {"channels": 10**9}, {"latency_s": 1e9}, {"every": 10**9},
    ],
)  # fmt: skip
def test_a_residual_network_without_end_is_refused_at_once(network: dict[str, Any]) -> None:
    with pytest.raises(SpecError, match=next(iter(network))):
        estimator("residual", network=network)


@pytest.mark.parametrize("base", ["", [], {}, {"sign_width": 1}, {"estimator": 3}, "rigid-wls"])
def test_physics_without_a_name_is_refused(base: object) -> None:
    with pytest.raises(SpecError, match="base is "):
        estimator("residual", base=base)


@pytest.mark.parametrize("given", [{"seeds": 10**9}, {"jobs": 10**9}, {"effort": 1e300}])
def test_a_study_without_end_is_refused_at_once(given: dict[str, Any]) -> None:
    with pytest.raises(SpecError, match="at most"):
        study("inverse-dynamics", **given)


@pytest.mark.parametrize(("name", "near"), [("lagrangian", "friction"), ("residual", "residual")])
def test_rates_of_groups_that_there_are_not_are_refused_before_a_robot_moves(name, near) -> None:
    wrong = near[:-2] + near[-1]
    with pytest.raises(SpecError, match=f"training.group_rates has '{wrong}'") as caught:
        estimator(name, training={"group_rates": {wrong: 2.0}})
    assert f"'{near}'" in caught.value.hint
    estimator(name, training={"group_rates": {near: 2.0}})


@pytest.mark.thorough
def test_a_rate_of_the_friction_does_nothing_where_there_is_none() -> None:
    pytest.importorskip("torch", reason="torch is not installed")
    training = LAGRANGIAN["training"] | {"group_rates": {"friction": 2.0, "dynamics": 0.5}}
    params = LAGRANGIAN | {"training": training, "friction": "none"}
    model = estimator("lagrangian", **params).fit(moving(1, 2), nominal())
    assert model.samples_ > 0


WHOLE = [60.0, 6e1, np.int64(60), np.float32(60), np.uint8(60)]
"""What files and sweeps have for 60."""


@pytest.mark.parametrize("sixty", WHOLE)
def test_a_whole_number_of_any_kind_is_one(sixty: Any) -> None:
    found = settings("training", {"epochs": sixty, "patience": sixty}, TrainingSettings)
    assert (repr(found.epochs), repr(found.patience)) == ("60", "60")
    assert repr(settings("network", {"hidden": [sixty]}, NetworkSettings).hidden) == "(60,)"
    for name in ("lagrangian", "residual"):
        estimator(name, training={"epochs": sixty, "batch_size": sixty})


@pytest.mark.parametrize("value", [True, np.True_, "5", b"5", 2.5, np.float64(2.5), np.nan, None])
def test_what_is_no_whole_number_is_not_taken_for_one(value: Any) -> None:
    for name in ("lagrangian", "residual"):
        with pytest.raises(SpecError, match=f"^{name}: training.epochs"):
            estimator(name, training={"epochs": value})
    with pytest.raises(SpecError, match=r"^lagrangian: network\.hidden"):
        estimator("lagrangian", network={"hidden": [value]})


def exit_code(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> object:
    """What `hil` ends with."""
    monkeypatch.setattr(sys, "argv", ["hil", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code


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
