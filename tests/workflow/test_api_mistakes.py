"""What the Python API takes; what is given wrongly is a `HilError` with a hint, no bare one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

import hil
from hil.arms.payload import Payload
from hil.core.errors import HilError
from tests.support.paths import EXPERIMENTS

SPEC = EXPERIMENTS / "ci_dwell_12.yaml"
FEWER = {"fit": "[{estimator: static-wls}]", "loads": "[{mass_kg: 1}]"}
Given = tuple[Path, Path]


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Given:
    """A run with a model, and a file where a folder is wanted."""
    home = tmp_path_factory.mktemp("api")
    (home / "file").write_text("no folder", "utf-8")
    report = hil.run(hil.load(SPEC, overrides=FEWER), runs=home / "runs")
    assert report.error is None
    return report.run, home / "file"


def wrong(value: object) -> Any:
    """A value of another type than the signature wants."""
    return cast("Any", value)


def model_of(run: Path) -> Path:
    return next((run / "fit").iterdir())


MISTAKES: dict[str, Callable[[Path, Path], object]] = {
    "a spec that is not there": lambda run, file: hil.load("none.yaml"),
    "no spec": lambda run, file: hil.load(wrong(None)),
    "a station that is not there": lambda run, file: hil.load(SPEC, "none.yaml"),
    "overrides in a list": lambda run, file: hil.load(SPEC, overrides=wrong(["seed=3"])),
    "an override without a name": lambda run, file: hil.load(SPEC, overrides=wrong({3: 3})),
    "a plan of a path": lambda run, file: hil.plan(wrong(SPEC)),
    "a run of a path": lambda run, file: hil.run(wrong(SPEC)),
    "a waiver without a reason": lambda run, file: hil.run(hil.load(SPEC), waivers=wrong(["disk"])),
    "a waiver with an empty reason": lambda run, file: hil.run(
        hil.load(SPEC), runs=file.parent / "waived", waivers={"disk": " "}
    ),
    "a reason that is no text": lambda run, file: hil.run(
        hil.load(SPEC), runs=file.parent / "waived", waivers=wrong({"disk": True})
    ),
    "no pose": lambda run, file: hil.rest_poses(model_of(run), count=0),
    "half a pose": lambda run, file: hil.rest_poses(model_of(run), count=wrong(0.5)),
    "a seed below nothing": lambda run, file: hil.rest_poses(model_of(run), seed=-1),
    "runs in a file": lambda run, file: hil.run(hil.load(SPEC), runs=file),
    "nothing to resume": lambda run, file: hil.resume(run),
    "no data": lambda run, file: hil.dataset(),
    "data that are not there": lambda run, file: hil.dataset("none"),
    "data in an empty list": lambda run, file: hil.dataset([]),
    "data in a list of lists": lambda run, file: hil.dataset(wrong([[run]])),
    "a column that is not there": lambda run, file: hil.dataset(run)["nope"],
    "no source": lambda run, file: hil.fit([], estimator="static-wls"),
    "a source that is no path": lambda run, file: hil.fit(wrong(hil), estimator="static-wls"),
    "no such estimator": lambda run, file: hil.fit(run, estimator="static-wsl"),
    "a model that is none": lambda run, file: hil.evaluate(run.parent, run),
    "no such parameter": lambda run, file: hil.fit(
        run, estimator="static-wls", parameters={"x": 1}
    ),
    "parameters in a list": lambda run, file: hil.fit(
        run, estimator="static-wls", parameters=wrong(["x=1"])
    ),
    "an argument as a parameter": lambda run, file: hil.fit(
        run, estimator="static-wls", parameters={"out": "x"}
    ),
    "a load that is a list": lambda run, file: hil.fit(
        run, estimator="static-wls", payload=wrong([1.5, 0, 0, 0.1])
    ),
    "a load that is an answer": lambda run, file: hil.fit(
        run, estimator="static-wls", payload=True
    ),
    "a load below nothing": lambda run, file: hil.rest_poses(model_of(run), payload=Payload(-1.0)),
    "models in a file": lambda run, file: hil.fit(run, estimator="static-wls", out=file),
    "models below a file": lambda run, file: hil.fit(run, estimator="static-wls", out=file / "x"),
    "a page of nothing": lambda run, file: hil.fit(run, estimator="static-wls", page="p.html"),
    "no such model": lambda run, file: hil.evaluate("none", run),
    "judged on what was fitted": lambda run, file: hil.evaluate(model_of(run), run),
    "judged on nothing": lambda run, file: hil.evaluate(model_of(run), []),
    "figures in a file": lambda run, file: hil.figures(run, file),
    "no such study": lambda run, file: hil.study(run, "nope"),
    "a name that cannot be": lambda run, file: hil.registry(file.parent / "r").register(
        "../x", model_of(run), {}
    ),
    "a name without models": lambda run, file: hil.registry(file.parent / "r").aliases("nobody"),
    "a registered run": lambda run, file: hil.registry(file.parent / "r").register("x", file, {}),
    "facts that are none": lambda run, file: hil.registry(file.parent / "r").register(
        "x", model_of(run), wrong("facts")
    ),
    "a schedule that is not there": lambda run, file: hil.reidentify("none.yaml"),
    "a spec as a schedule": lambda run, file: hil.reidentify(SPEC),
}


@pytest.mark.thorough
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_told_with_what_to_do(
    mistake: str, given: Given, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(HilError) as told:
        MISTAKES[mistake](*given)
    assert told.value.hint


@pytest.mark.thorough
def test_a_model_is_registered_with_what_it_and_its_run_tell(given: Given, tmp_path: Path) -> None:
    run, _ = given
    facts = hil.registry(tmp_path / "r").register("ur5", model_of(run)).facts
    assert (facts["estimator"], facts["run"]["folder"]) == ("static-wls", str(run))


@pytest.mark.thorough
def test_the_same_model_twice_is_one_version(given: Given, tmp_path: Path) -> None:
    registry, model = hil.registry(tmp_path / "r"), model_of(given[0])
    first, again = (registry.register("ur5", one, {}) for one in (model, str(model)))
    assert first.number == again.number == 1


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("payload", "load"),
    [
        (0, Payload()),
        ("0", Payload()),
        (1.5, Payload(1.5)),
        (np.float64(1.5), Payload(1.5)),
        ("1.5,0,0,0.1", Payload(1.5, (0.0, 0.0, 0.1))),
        (Payload(1.5, (0.0, 0.0, 0.1), (1e-3,) * 6), Payload(1.5, (0.0, 0.0, 0.1), (1e-3,) * 6)),
    ],
)
def test_a_load_is_a_number_a_text_or_a_payload_and_0_is_nothing_mounted(
    payload: Any, load: Payload, given: Given, tmp_path: Path
) -> None:
    fitted = hil.fit(given[0], estimator="static-wls", payload=payload, out=tmp_path).fitted
    assert fitted.model.training_ is not None
    assert fitted.model.training_.payloads == (load,)


@pytest.mark.thorough
def test_recordings_come_one_by_one_or_in_a_list(given: Given) -> None:
    run, _ = given
    rows = len(hil.dataset(run))
    for asked in ((run, str(run)), ([run, run],), ((one for one in (run, run)),), ([run], run)):
        assert len(hil.dataset(*asked)) == 2 * rows
