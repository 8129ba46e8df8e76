"""Models of a fleet: the same bits wherever they are fitted, and who stands out."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from operator import mul
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core.errors import DataError
from hil.core.parallel import one_thread, spread_over_processes
from hil.data.dataset import Dataset
from hil.maintenance.fleet_specs import experiment_for, spec_for
from hil.models import fleet_fits
from hil.models.drift import identity
from hil.models.fleet_fits import (
    FitResult,
    FitSettings,
    fit_at,
    fit_runs,
    fit_split,
    register_fit,
    split_of,
    store_fits,
)
from hil.models.fleet_outliers import FAMILY_WISE, FEWEST, compare_robots, huber
from hil.models.fleet_survey import _model_of
from hil.models.model_registry import Registry
from hil.spec.experiment import ContradictedLimit, HoldOut, RmseLimit
from hil.workflow.running import run as run_experiment
from tests.support.fleet_parts import FITTED, written

# Fits of a fleet: the same bits wherever, what dies is computed again, who becomes champion


HOW = FitSettings("rigid-wls")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A run of each of two robots."""
    folder = tmp_path_factory.mktemp("fleet")
    spec, station = written(folder, {"a": "seed: 1", "b": "seed: 2"}, FITTED)
    made = []
    for name in "ab":
        text = spec_for(FITTED, "small.yaml", name)
        made.append(experiment_for(text, folder, station, spec))
    with one_thread():
        return [run_experiment(one, runs=folder / "runs").run for one in made]


@pytest.fixture(scope="module")
def results(runs: list[Path]) -> list[FitResult]:
    """Of fits in processes of this computer."""
    return fit_runs(runs, HOW, workers=2)


class Elsewhere(Executor):
    """A worker that gets what is sent, and sees no file of ours."""

    def __init__(self, hidden: Path) -> None:
        self.hidden, self.threads = hidden, 1

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        sent, future = pickle.dumps((fn, args)), Future[Any]()
        away = self.hidden.rename(self.hidden.with_name("away"))
        try:
            task, given = pickle.loads(sent)
            future.set_result(task(*given))
        finally:
            away.rename(self.hidden)
        return future


def once(mark: str) -> int:
    """Takes its process along the first time."""
    if not Path(mark).exists():
        Path(mark).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return 42


def always() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.thorough
def test_a_model_is_the_one_its_run_has_fitted(runs: list[Path], results: list[FitResult]) -> None:
    for run, result in zip(runs, results, strict=True):
        own = run / "fit" / result.folder
        assert (own / "model.safetensors").read_bytes() == result.files["model.safetensors"]
        assert (own / "model.json").read_bytes() == result.files["model.json"]


@pytest.mark.thorough
def test_a_worker_that_sees_no_run_is_sent_the_samples_and_finds_the_same_bits(
    runs: list[Path], results: list[FitResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    @contextmanager
    def hidden(address: str | None) -> Iterator[Executor]:
        yield Elsewhere(runs[0].parents[1])

    monkeypatch.setattr(fleet_fits, "cluster", hidden)
    counts: list[int] = []
    found = fit_runs(runs, HOW, workers=1, dask="tcp://127.0.0.1:8786", on_progress=counts.append)
    assert [one.files for one in found] == [one.files for one in results]
    assert counts == [0, 2]


@pytest.mark.thorough
def test_another_run_at_the_same_path_is_not_taken_for_it(runs: list[Path]) -> None:
    assert fit_at(runs[0], "another", HOW) is None
    assert fit_at(runs[0].with_name("gone"), "another", HOW) is None


@pytest.mark.thorough
def test_a_dask_cluster_finds_the_same_bits_by_path_and_by_samples(
    runs: list[Path], results: list[FitResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed = pytest.importorskip("distributed", reason="distributed is not installed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address="127.0.0.1:0", host="127.0.0.1"
    ) as made:
        seen = fit_runs(runs, HOW, workers=1, dask=made.scheduler_address)
        # workers find another run there than the one they are asked for
        monkeypatch.setattr(fleet_fits, "identity", lambda run: ("another", ""))
        sent = fit_runs(runs, HOW, workers=1, dask=made.scheduler_address)
    for found in (seen, sent):
        assert [one.files for one in found] == [one.files for one in results]


@pytest.mark.thorough
def test_what_a_dead_process_took_along_is_computed_again(tmp_path: Path) -> None:
    tasks = [partial(mul, 2, 1), partial(once, str(tmp_path / "mark")), partial(mul, 2, 3)]
    assert spread_over_processes(tasks, 2, lambda done: None, lambda i: None) == [2, 42, 6]


@pytest.mark.thorough
def test_a_fit_that_always_kills_its_process_leaves_the_others_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tasks = {"a": always, "b": partial(FitResult, "model"), "c": partial(FitResult, "model")}
    monkeypatch.setattr(fleet_fits, "_task", lambda run, settings: tasks[run.name])
    found = fit_runs([Path(name) for name in tasks], HOW, workers=1)
    assert found[0].error == fleet_fits.DIED
    assert [one.folder for one in found] == ["", "model", "model"]


@pytest.mark.thorough
def test_runs_that_cannot_be_fitted_or_were_deleted_leave_the_others_alone(
    runs: list[Path], results: list[FitResult], tmp_path: Path
) -> None:
    broken = tmp_path / "0009-broken"
    broken.mkdir()
    start = json.loads((runs[0] / "start.json").read_text("utf-8")) | {"robot_name": "d"}
    (broken / "start.json").write_text(json.dumps(start), "utf-8")
    gone = tmp_path / "2026-11-22" / "c" / "0001-small"
    every = [broken, gone, runs[1]]
    found = fit_runs(every, HOW, workers=1)
    assert "plan.json" in found[0].error
    assert "does not exist" in found[1].error
    assert found[2].files == results[1].files
    stored = store_fits(every, found, tmp_path)
    assert [(one.robot, one.model is None) for one in stored] == [
        ("d", True), ("c", True), ("b", False),
    ]  # fmt: skip


@pytest.mark.thorough
def test_a_model_is_judged_as_its_run_has_judged_it(
    runs: list[Path], results: list[FitResult]
) -> None:
    for run, result in zip(runs, results, strict=True):
        own = json.loads((run / "fit" / result.folder / "evaluation.json").read_text("utf-8"))
        del own["seconds"]
        assert json.loads(result.files["evaluation.json"]) == own
        assert result.passed is True


@pytest.mark.thorough
def test_a_first_model_becomes_champion_the_next_its_challenger(
    runs: list[Path], results: list[FitResult], tmp_path: Path
) -> None:
    registry = Registry(tmp_path / "registry")
    (first,) = store_fits(runs[:1], results[:1], tmp_path)
    assert register_fit(first, registry).role == "champion"
    assert register_fit(first, registry).role == "champion"
    (entry,) = [one for one in registry.log("a") if one.event == "promoted"]
    assert entry.evidence["evaluation"]
    assert registry.version("a").facts["run"]["folder"] == str(runs[0])
    more = fit_runs(runs[:1], FitSettings("rigid-linear"), workers=1)
    other = register_fit(*store_fits(runs[:1], more, tmp_path), registry)
    assert (other.registered, other.role) == ("v2", "challenger")


@pytest.mark.thorough
def test_the_model_stored_last_is_that_of_the_survey(runs: list[Path], tmp_path: Path) -> None:
    fleet: Any = SimpleNamespace(models=tmp_path)
    for name in ("first-1", "other-1", "first-1"):
        store_fits(runs[:1], [FitResult(name, {"model.json": b"{}"})], tmp_path)
        assert _model_of(fleet, runs[0]) == tmp_path / "a" / name
        time.sleep(0.02)  # file systems tell no shorter times apart


@pytest.mark.thorough
def test_a_name_that_cannot_be_registered_costs_no_other_robot(
    runs: list[Path], tmp_path: Path
) -> None:
    registry = tmp_path / "registry"
    registry.mkdir()
    (registry / "a").write_text("no folder", "utf-8")
    more = ["-e", "rigid-wls", "-o", str(tmp_path), "--workers", "1", "--json", "--register"]
    named = [*map(str, runs), "--registry", str(registry)]
    done = CliRunner().invoke(app, ["fleet", "fit", *named, *more])
    assert done.exit_code == 11
    found = json.loads(done.stdout)["fits"]
    assert [one["registered"] for one in found] == [None, "v1"]


@pytest.mark.thorough
def test_what_misses_its_criteria_or_its_runs_becomes_neither(
    runs: list[Path], results: list[FitResult], tmp_path: Path
) -> None:
    registry = Registry(tmp_path / "registry")
    (fit,) = store_fits(runs[:1], [replace(results[0], passed=False)], tmp_path)
    assert register_fit(fit, registry).role == ""
    rejected = tmp_path / "runs" / "0001-rejected"
    shutil.copytree(runs[0], rejected)
    (rejected / "verdict.json").write_text('{"passed": false}', "utf-8")  # by its gaps, say
    (fit,) = store_fits([rejected], results[:1], tmp_path)
    assert (fit.result.passed, fit.verdict) == (True, "rejected")
    assert register_fit(fit, registry).role == ""
    assert registry.aliases("a").champion == registry.aliases("a").challenger == 0


@pytest.mark.thorough
def test_what_nobody_has_judged_becomes_no_champion(
    runs: list[Path], results: list[FitResult], tmp_path: Path
) -> None:
    registry = Registry(tmp_path / "registry")
    (fit,) = store_fits(runs[:1], [replace(results[0], passed=None)], tmp_path)
    assert register_fit(fit, registry).role == "challenger"
    assert registry.aliases("a").champion == 0


@pytest.mark.thorough
def test_criteria_that_only_a_run_judges_are_not_called_met(runs: list[Path]) -> None:
    learnt = split_of(runs[0], HOW)
    asked = learnt.accept.model_copy(update={"contradicted_loads": ContradictedLimit(max=0)})
    assert fit_split(replace(learnt, accept=asked), HOW).passed is None
    missed = asked.model_copy(update={"rmse": RmseLimit(max=1e-6, unit="A", per="mean")})
    assert fit_split(replace(learnt, accept=missed), HOW).passed is False


@pytest.mark.thorough
def test_what_cannot_be_held_out_is_an_error_and_no_model(
    runs: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def nothing(data: Dataset, how: HoldOut) -> None:
        raise DataError("the sides share samples")

    monkeypatch.setattr(fleet_fits, "hold_out", nothing)
    found = fit_at(runs[0], identity(runs[0])[0], HOW)
    assert found is not None
    assert (found.files, found.error) == ({}, "the sides share samples")


@pytest.mark.thorough
def test_a_name_that_another_robot_has_is_refused(
    runs: list[Path], results: list[FitResult], tmp_path: Path
) -> None:
    registry = Registry(tmp_path / "registry")
    first, other = store_fits(runs, results, tmp_path)
    register_fit(replace(first, robot="arm"), registry)
    refused = register_fit(replace(other, robot="arm"), registry)
    assert (refused.registered, refused.role) == ("", "")
    assert "belongs to serial number a-" in refused.error
    assert len(registry.versions("arm")) == 1


@pytest.mark.thorough
def test_fits_on_the_command_line(runs: list[Path], tmp_path: Path) -> None:
    named = [str(run) for run in runs]
    more = ["-e", "rigid-wls", "-o", str(tmp_path), "--workers", "1", "--json"]
    done = CliRunner().invoke(app, ["fleet", "fit", *named, *more])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)["fits"]
    assert [(one["robot"], one["verdict"]) for one in told] == [("a", "passed"), ("b", "passed")]
    assert all(Path(one["model"]).is_dir() and one["passed"] for one in told)
    wrong = CliRunner().invoke(app, ["fleet", "fit", *named, "-e", "rigid-wls", "--dask", "here"])
    assert "not the address of a Dask scheduler" in str(wrong.exception)


# Who stands out of a fleet: at the stated rate among equals, and who is really different


YEARS, JOINTS = np.linspace(1.0, 10.0, 40), 6
TREND = np.array([0.02, 0.03, 0.0, 0.01, 0.02, 0.02])


def fleet(seed: int, spread: float = 0.03) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0.0, spread, (len(YEARS), JOINTS))
    return np.exp(np.log(5.0) + YEARS[:, None] * TREND + noise)


def test_a_trend_with_age_is_found_and_explains_itself() -> None:
    found = compare_robots(fleet(1), {"age": YEARS})
    assert found is not None
    assert np.all(np.abs(found.slopes[0] - TREND) < 4 * found.errors[0])
    assert np.all(found.errors[0] < 0.005)
    assert not found.outlying.any()


def test_one_joint_with_more_friction_stands_out_and_nobody_else() -> None:
    values = fleet(2)
    values[17, 2] *= 1.3
    found = compare_robots(values, {"age": YEARS})
    assert found is not None
    assert [tuple(at) for at in np.argwhere(found.outlying)] == [(17, 2)]
    assert found.expected[17, 2] == pytest.approx(5.0, rel=0.05)


@pytest.mark.thorough
def test_equals_stand_out_in_as_many_fleets_as_is_said() -> None:
    alarms = 0
    for seed in range(200):
        found = compare_robots(fleet(1000 + seed)[:12], {"age": YEARS[:12]})
        assert found is not None
        alarms += bool(found.outlying.any())
    # 200 fleets at 1 %: 2 are expected, 8 or more in one of 900 such tests
    assert 200 * FAMILY_WISE == 2
    assert alarms < 8


def test_three_wrong_robots_of_twelve_do_not_hide_one_another() -> None:
    values = fleet(3)[:12] / np.exp(YEARS[:12, None] * TREND)
    values[:3, 0] *= 2.0
    found = compare_robots(values, {})
    assert found is not None
    assert set(np.flatnonzero(found.outlying[:, 0])) == {0, 1, 2}


def test_of_few_robots_or_none_with_a_model_nothing_is_said() -> None:
    assert compare_robots(fleet(4)[: FEWEST - 1], {"age": YEARS[: FEWEST - 1]}) is None
    assert compare_robots(np.empty((40, 0)), {"age": YEARS}) is None


def test_who_does_not_tell_its_age_is_left_out_and_the_others_still_explained() -> None:
    values, age = fleet(5), YEARS.copy()
    age[3] = np.nan
    values[7, 1] = np.nan
    found = compare_robots(values, {"age": age, "same": np.ones(len(age))})
    assert found is not None
    assert (found.names, found.left_out, found.unused) == (("age",), {"age": (3,)}, ())
    assert np.isnan(found.z[[3, 7]]).all()
    assert np.isfinite(np.delete(found.z, [3, 7], axis=0)).all()


def test_what_few_tell_explains_nothing_and_leaves_nobody_out() -> None:
    age = np.where(np.arange(len(YEARS)) < 15, YEARS, np.nan)
    found = compare_robots(fleet(5), {"age": age, "temperature": np.full(age.shape, np.nan)})
    assert found is not None
    assert (found.names, found.left_out, found.unused) == ((), {}, ("age",))
    assert np.isfinite(found.z).all()


@pytest.mark.thorough
def test_the_limit_is_crossed_by_one_fleet_of_a_hundred() -> None:
    found = compare_robots(fleet(1), {})
    assert found is not None
    dice, columns = np.random.default_rng(9), np.ones((len(YEARS), 1))
    noise = dice.standard_normal((len(YEARS), 4000 * JOINTS))
    beta, scale = huber(columns, noise)
    largest = np.max(np.abs(noise - beta) / scale, axis=0).reshape(4000, JOINTS).max(axis=1)
    # at 1 %, and with a limit that was itself simulated with 1500 fleets
    assert 0.004 < np.mean(largest > found.limit) < 0.02


def test_robust_regression_is_that_of_statsmodels() -> None:
    statsmodels = pytest.importorskip("statsmodels.api")
    y = np.log(fleet(6)[:, 0])
    y[5] += 1.0
    X = np.column_stack([np.ones(len(y)), YEARS])
    beta, scale = huber(X, y[:, None])
    peer = statsmodels.RLM(y, X, M=statsmodels.robust.norms.HuberT(1.345)).fit(maxiter=200)
    assert beta[:, 0] == pytest.approx(peer.params, rel=1e-3, abs=1e-4)
    assert scale[0] == pytest.approx(peer.scale, rel=0.05)
