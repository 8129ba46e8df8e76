"""What a policy lets go, and that it is never what a registered model came from."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core.errors import DataError, RegistryError, SpecError
from hil.core.lock_file import hold_run
from hil.models.model_registry import Registry
from hil.models.version import ModelVersion, numbers_in, write_version
from hil.recording.run_directory import RunDirectory, run_folders
from hil.report import render_report
from hil.runs import origins
from hil.runs.catalogue import find_runs
from hil.runs.retention import Policy, decide, leftovers, remove
from hil.workflow.resuming import open_unfinished
from tests.support.catalogue_runs import settle, write_run

NOW = datetime.fromisoformat("2026-12-01T00:00:00+00:00").timestamp()
ALL = Policy(older=timedelta(days=1))


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    root = tmp_path / "runs"
    for number in range(1, 5):
        write_run(root, number, day=f"2026-11-{10 + number}")
    write_run(root, 5, day="2026-11-15", outcome=None)
    write_run(root, 6, day="2026-11-16", robot="ur10")
    return root


def version(root: Path, facts: dict[str, Any], name: str = "ur5") -> None:
    """Register what is known of a model; the model itself does not matter here."""
    home = root / name
    home.mkdir(parents=True, exist_ok=True)
    number = max(numbers_in(home), default=0) + 1
    folder = home / f"v{number:04d}"
    stamp = "2026-11-30T00:00:00.000+00:00"
    write_version(home, ModelVersion(name, number, folder, str(number), stamp, "me", facts, {}), {})
    Registry(root).rebuild(name)


def run_number(runs: Path, number: int) -> Path:
    (found,) = runs.glob(f"*/*/{number:04d}-*")
    return found


def gone(runs: Path, policy: Policy = ALL, *registries: Path) -> list[int]:
    decisions = decide(runs, policy, registries, NOW)
    return [int(one.run.name[:4]) for one in decisions if one.goes]


def why(runs: Path, number: int, *registries: Path, policy: Policy = ALL) -> str:
    found = {int(one.run.name[:4]): one.why for one in decide(runs, policy, registries, NOW)}
    return found[number]


def test_a_policy_says_how_old_and_how_many(runs: Path) -> None:
    assert gone(runs) == [1, 2, 3, 4, 6]
    assert gone(runs, Policy(older=timedelta(days=18))) == [1, 2]
    assert gone(runs, Policy(keep=1)) == [1, 2, 3]
    assert gone(runs, Policy(keep=1, older=timedelta(days=19))) == [1]
    assert gone(runs, Policy(("robot=ur10",), older=timedelta(days=1))) == [6]
    assert gone(runs, Policy(older=timedelta(days=1), interrupted=True)) == [1, 2, 3, 4, 5, 6]


def test_failed_runs_push_no_completed_one_out(runs: Path) -> None:
    for number in (7, 8, 9):
        write_run(runs, number, day="2026-11-20", outcome="failed")
    assert gone(runs, Policy(keep=2)) == [1, 2]


def test_a_policy_without_a_limit_is_refused(runs: Path) -> None:
    with pytest.raises(SpecError, match="would delete every run"):
        decide(runs, Policy(("robot=ur5",)), ())


def _of_run(run: Path) -> dict[str, Any]:
    return {"run": {"uid": f"uid-ur5-{int(run.name[:4])}", "folder": "moved/elsewhere/since"}}


def _of_folder(run: Path) -> dict[str, Any]:
    return {"run": {"uid": "", "folder": str(Path("/old/place", *run.parts[-3:]))}}


def _of_name(run: Path) -> dict[str, Any]:
    return {"run": None, "trained_on": [run.name], "uids": [run_uid(run)]}


def run_uid(run: Path) -> str:
    return str(json.loads((run / "start.json").read_bytes())["uid"])


def _of_digest(run: Path) -> dict[str, Any]:
    digest = hashlib.sha256((run / "recording" / "00.mcap").read_bytes()).hexdigest()
    return {"run": None, "trained_on": ["copy.mcap"], "data_sha256": {"copy.mcap": digest}}


def _of_nobody_knows(_: Path) -> dict[str, Any]:
    return {"run": None, "trained_on": [], "data_sha256": {}}


def _of_file(_: Path) -> dict[str, Any]:
    return {"run": None, "trained_on": ["00.mcap"], "data_sha256": {}}


def _of_two_runs(run: Path) -> dict[str, Any]:
    """Of a run that is known by all it has, and of this one by its name."""
    other = {"uid": "another", "folder": "/runs/2026-11-02/ur5/0099-other"}
    return {"run": other, "trained_on": ["0099-other", run.name], "uids": [run_uid(run)]}


def _of_files_of_two_runs(_: Path) -> dict[str, Any]:
    """Of the first recordings of two runs, one of which is known with all it has."""
    digests = {f"recording/{name}.mcap": name * 2 for name in ("00", "00.001", "01")}
    other = {"uid": "another", "folder": "/runs/2026-11-02/ur5/0099-other"}
    return {"run": other, "trained_on": ["00.mcap", "00.mcap"], "data_sha256": digests}


LINKS = (
    _of_run, _of_folder, _of_name, _of_digest, _of_file, _of_nobody_knows, _of_two_runs,
    _of_files_of_two_runs,
)  # fmt: skip


@pytest.mark.parametrize("link", LINKS)
def test_what_a_version_came_from_stays(link: Any, runs: Path, tmp_path: Path) -> None:
    version(tmp_path / "models", link(run_number(runs, 2)))
    assert 2 not in gone(runs, ALL, tmp_path / "models")
    assert re.match("ur5 v1 was (possibly )?fitted to it", why(runs, 2, tmp_path / "models"))


class Remembers:
    """What a model of `version` remembers of its rows: whose they are."""

    def __init__(self, model: Path) -> None:
        self.uids = json.loads((model / "version.json").read_bytes())["facts"].get("uids", ())

    def share_known(self, uid: str) -> float:
        return float(uid in self.uids)


@pytest.fixture(scope="module", autouse=True)
def rows() -> Iterator[None]:
    """Recordings here have no rows: a run's uid stands for them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(origins, "load_source", lambda run, **how: run_uid(run))
        patch.setattr(origins, "_sketch", Remembers)
        yield


@pytest.mark.parametrize("link", [one for one in LINKS if one is not _of_folder])
def test_it_stays_when_it_is_renamed(link: Any, runs: Path, tmp_path: Path) -> None:
    run = run_number(runs, 2)
    version(tmp_path / "models", link(run))
    run.rename(run.with_name("0002-called-otherwise"))
    assert re.match("ur5 v1 was (possibly )?fitted to it", why(runs, 2, tmp_path / "models"))


def test_a_recording_of_which_only_the_name_is_known_keeps_all_it_may_be(
    runs: Path, tmp_path: Path
) -> None:
    version(tmp_path / "models", _of_file(runs) | {"serial": "ur10-s"})
    assert gone(runs, ALL, tmp_path / "models") == [1, 2, 3, 4]
    write_run(runs, 9, day="2026-12-24", robot="ur10")  # after it was registered
    decisions = decide(runs, ALL, [tmp_path / "models"], NOW + 90 * 86_400)
    assert [one.why for one in decisions if one.run.name == "0009-fourier"] == [""]


def test_an_interrupted_run_stays_by_the_digest_of_its_recording(
    runs: Path, tmp_path: Path
) -> None:
    version(tmp_path / "models", _of_digest(run_number(runs, 5)))
    policy = Policy(older=timedelta(days=1), interrupted=True)
    assert 5 not in gone(runs, policy, tmp_path / "models")


def test_probes_of_the_champion_stay_and_others_may_go(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:

    version(tmp_path / "models", {"run": {"uid": "another"}})
    version(tmp_path / "models", {"run": {"uid": "another"}})
    home = Registry(tmp_path / "models")
    home.promote("ur5", 2, reason="", evidence={}, instead_of=0)

    class Of:
        def __init__(self, uid: str, champion: int) -> None:
            self.uid, self.champion = uid, champion

    monkeypatch.setattr(
        "hil.runs.origins.probes_of", lambda *_: [Of("uid-ur5-1", 1), Of("uid-ur5-3", 2)]
    )
    assert gone(runs, ALL, tmp_path / "models") == [1, 2, 4, 6]
    assert why(runs, 3, tmp_path / "models") == "it is a probe of ur5 v2"


def test_a_live_run_stays(runs: Path) -> None:
    with hold_run(run_number(runs, 2)):
        assert why(runs, 2) == "it is live"
        (decision,) = [one for one in decide(runs, ALL, (), NOW) if one.run.name == "0003-fourier"]
    with hold_run(decision.run):  # taken in hand between the decision and the deed
        (done,) = remove([decision], runs, ALL, ())
    assert "is active" in done.why
    assert RunDirectory.open(decision.run).status == "completed"


def test_a_damaged_run_stays(runs: Path) -> None:
    (run_number(runs, 2) / "start.json").write_text("{")
    assert why(runs, 2).startswith("it is damaged")


def test_runs_of_a_series_stay_together(runs: Path, tmp_path: Path) -> None:
    folder = runs / "2026-11-12" / "series" / "series-both"
    folder.mkdir(parents=True)
    members = [{"run": os.path.relpath(run_number(runs, n), folder)} for n in (2, 3)]
    document = {"hil_series_run": 1, "name": "both", "runs": members}
    (folder / "series.json").write_text(json.dumps(document))
    assert gone(runs) == [1, 2, 3, 4, 6]
    version(tmp_path / "models", _of_name(run_number(runs, 3)))
    assert gone(runs, ALL, tmp_path / "models") == [1, 4, 6]
    reason = why(runs, 2, tmp_path / "models")
    assert "it belongs to series-both, whose run 0003-fourier stays" in reason
    (folder / "series.json").write_text("[]")
    with pytest.raises(DataError) as caught:
        gone(runs)
    assert "repair its folder or move it away" in caught.value.hint


def _missing(models: Path) -> None:
    shutil.rmtree(models)


def _damaged(models: Path) -> None:
    (models / "ur5" / "v0001" / "version.json").chmod(0o600)
    (models / "ur5" / "v0001" / "version.json").write_text("{")


def _torn_log(models: Path) -> None:
    (models / "ur5" / "log.jsonl").write_text("{}\n")


def _lost_version(models: Path) -> None:
    shutil.rmtree(models / "ur5" / "v0001")


def _lost_one_of_two(models: Path) -> None:
    version(models, {})
    shutil.rmtree(models / "ur5" / "v0001")


def _bad_probe(models: Path) -> None:
    (models / "ur5" / "probes.jsonl").write_text("{}\n")


@pytest.mark.thorough
@pytest.mark.parametrize(
    "spoil", [_missing, _damaged, _torn_log, _lost_version, _lost_one_of_two, _bad_probe]
)
def test_a_registry_that_cannot_be_read_keeps_everything(
    spoil: Any, runs: Path, tmp_path: Path
) -> None:
    models = tmp_path / "models"
    version(models, {})
    spoil(models)
    arguments = ["prune", "--older-than", "1d", "--yes", "--runs", str(runs)]
    told = CliRunner().invoke(app, [*arguments, "--registry", str(models)])
    assert isinstance(told.exception, RegistryError)
    assert len(find_runs(runs=runs)) == 6


def test_registries_at_the_usual_places_count_unnamed(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for place, number in (("here/registry", 1), ("registry", 2), ("of-the-lab", 3)):
        version(tmp_path / place, _of_name(run_number(runs, number)))
    monkeypatch.setenv("HIL_REGISTRY", str(tmp_path / "of-the-lab"))
    told = CliRunner().invoke(app, ["prune", "--older-than", "1d", "--runs", str(runs), "--json"])
    stays = [Path(one["run"]).name[:4] for one in json.loads(told.stdout)["runs"] if one["why"]]
    assert stays == ["0001", "0002", "0003", "0005"]


def test_nothing_is_deleted_unasked(runs: Path) -> None:
    arguments = ["prune", "--older-than", "1d", "--runs", str(runs)]
    told = CliRunner().invoke(app, arguments).stdout
    assert "would be deleted: 5 runs" in told
    assert "no registry was found, so --yes is refused: pass --registry DIR" in told
    assert "nothing was deleted without --yes" not in told
    told = CliRunner().invoke(app, [*arguments, "--no-registry"]).stdout
    assert "nothing was deleted without --yes" in told
    assert len(find_runs(runs=runs)) == 6
    refused = CliRunner().invoke(app, [*arguments, "--yes"])
    assert isinstance(refused.exception, RegistryError)
    assert len(find_runs(runs=runs)) == 6
    told = CliRunner().invoke(app, [*arguments, "--yes", "--no-registry"]).stdout
    assert "deleted: 5 runs" in told
    assert [run["number"] for run in find_runs(runs=runs)] == [5]
    assert not (runs / "2026-11-11" / "ur5").exists()


@pytest.mark.parametrize(
    ("robot", "stays"), [("ur10", "1 more run is kept"), ("ur5", "4 more runs are kept, each")]
)
def test_how_many_stay_and_the_age_as_it_was_typed(robot: str, stays: str, runs: Path) -> None:
    asked = [f"robot={robot}", "--older-than", "36500d"]
    told = CliRunner().invoke(app, ["prune", *asked, "--runs", str(runs)])
    assert f"{stays} because it is younger than 36500d" in told.stdout.splitlines(), told.stdout


def test_recordings_go_and_documents_stay(runs: Path) -> None:
    policy = Policy(older=timedelta(days=1), recordings_only=True)
    (run_number(runs, 2) / "report.html").write_text("with plots")
    remove(decide(runs, policy, (), NOW), runs, policy, ())
    run = RunDirectory.open(run_number(runs, 2))
    assert run.recordings == ()
    assert run.verify() == []
    assert run.pruned == {"recording/00.mcap"}
    assert find_runs("number=2", runs=runs)[0]["samples"] == 100
    assert not list(run.path.glob(".trash*"))
    assert gone(runs, policy) == []
    assert why(runs, 2, policy=policy) == "it has no recording"
    for refused in (open_unfinished, render_report):
        with pytest.raises(DataError, match="were deleted"):
            refused(run.path)
    assert (run.path / "report.html").read_text() == "with plots"
    (run.path / "recording").mkdir()
    (run.path / "recording" / "00.mcap").write_bytes(b"another")
    assert run.verify() == ["recording/00.mcap has changed since the run ended"]


def test_what_a_killed_deletion_left_is_no_run_and_goes_with_the_next(runs: Path) -> None:
    run = run_number(runs, 2)
    run.rename(run.with_name(".trash-0123-0002-fourier"))
    assert 2 not in [one["number"] for one in find_runs(runs=runs)]
    assert len(leftovers(runs)) == 1
    remove([], runs, ALL, ())
    assert leftovers(runs) == []


@pytest.mark.parametrize("recordings_only", [False, True])
def test_what_is_half_deleted_is_no_run_and_no_recording(
    recordings_only: bool, runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(folder: Path, **_: object) -> None:
        next(path for path in Path(folder).rglob("*") if path.is_file()).unlink()
        raise KeyboardInterrupt

    policy = Policy(older=timedelta(days=1), recordings_only=recordings_only)
    before = {Path(one["run"]): tree(Path(one["run"])) for one in find_runs(runs=runs)}
    decisions = decide(runs, policy, (), NOW)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", killed)
        with pytest.raises(KeyboardInterrupt):
            remove(decisions, runs, policy, ())
    first = runs / "2026-11-11" / "ur5" / "0001-fourier"
    assert first.exists() == recordings_only
    assert not (first / "recording").exists()
    assert len(leftovers(runs)) == 1
    whole = {run: content for run, content in before.items() if run != first}
    assert {run: tree(run) for run in whole} == whole
    remove(decide(runs, policy, (), NOW), runs, policy, ())
    assert leftovers(runs) == []
    assert gone(runs, policy) == []


@pytest.mark.thorough
def test_a_deletion_killed_anywhere_leaves_whole_runs(runs: Path) -> None:
    for number in range(10, 60):
        write_run(runs, number, day="2026-11-01")
    before = {one["run"]: tree(Path(one["run"])) for one in find_runs(runs=runs)}
    command = [sys.executable, "-m", "hil", "prune", "--older-than", "1d", "--yes", "--no-registry"]
    pruning = subprocess.Popen([*command, "--runs", str(runs)], cwd=runs, stdout=subprocess.DEVNULL)
    until = time.monotonic() + 30
    while len(run_folders(runs)) > 40 and time.monotonic() < until:
        time.sleep(0.001)
    pruning.send_signal(signal.SIGKILL)
    pruning.wait()
    left = find_runs(runs=runs)
    assert 0 < len(left) <= 40
    assert {one["run"]: tree(Path(one["run"])) for one in left}.items() <= before.items()


def tree(folder: Path) -> dict[str, bytes]:
    """Content of all documents and recordings."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


OLD = {"older": 0, "keep": None, "interrupted": False, "recordings_only": False}
DONE = ["completed", "completed"]


@pytest.mark.thorough
@example(outcomes=DONE, links=[(0, _of_two_runs)], renamed=True, **OLD)
@example(outcomes=DONE, links=[(0, _of_files_of_two_runs)], renamed=True, **OLD)
@settings(max_examples=25, deadline=None)
@given(
    outcomes=st.lists(st.sampled_from(["completed", "failed", None]), min_size=2, max_size=7),
    links=st.lists(st.tuples(st.integers(0, 6), st.sampled_from(LINKS)), max_size=4),
    older=st.none() | st.integers(0, 60),
    keep=st.none() | st.integers(1, 3),
    interrupted=st.booleans(),
    recordings_only=st.booleans(),
    renamed=st.booleans(),
)
def test_no_policy_ever_takes_what_a_registered_model_came_from(
    outcomes: list[str | None],
    links: list[tuple[int, Any]],
    older: int | None,
    keep: int | None,
    interrupted: bool,
    recordings_only: bool,
    renamed: bool,
) -> None:
    if older is None and keep is None:
        older = 0
    with tempfile.TemporaryDirectory() as folder:
        root, models = Path(folder) / "runs", Path(folder) / "models"
        models.mkdir()
        made = [
            write_run(root, n + 1, day=f"2026-11-{n + 1:02d}", outcome=outcome)
            for n, outcome in enumerate(outcomes)
        ]
        links = [(n % len(made), link) for n, link in links]
        for n, link in links:
            version(models, link(made[n]))
        for n in {n for n, _ in links if renamed and (n, _of_folder) not in links}:
            made[n] = made[n].rename(made[n].with_name(f"{made[n].name}-renamed"))
        of_models = {made[n] for n, _ in links}
        whole = {run: tree(run) for run in of_models}
        age = None if older is None else timedelta(days=older)
        policy = Policy((), age, keep, interrupted, recordings_only)
        done = remove(decide(root, policy, [models], NOW), root, policy, [models])
        assert {run: tree(run) for run in of_models} == whole
        assert all(one.why for one in done if one.run in of_models)
        if not recordings_only:
            assert {one.run for one in done if one.goes} == {
                run for run in made if not run.exists()
            }


def test_the_model_of_a_run_keeps_it_by_what_is_noted_when_it_is_registered(
    runs: Path, tmp_path: Path
) -> None:
    from hil.estimators import estimator
    from hil.models.model_registry import facts_of
    from tests.support.synthetic_motion import moving, nominal

    run = run_number(runs, 4)
    motion = moving(1, 2, 3)
    of_run = tuple(replace(one, source=str(run)) for one in motion.conditions)
    model = estimator("rigid-wls").fit(replace(motion, conditions=of_run), nominal())
    fitted = model.save(run / "fit" / "rigid-wls-0")
    Registry(tmp_path / "models").register("ur5", fitted, facts_of(fitted))
    settle(run)
    assert gone(runs, ALL, tmp_path / "models") == [1, 2, 3, 6]
    moved = run.rename(run.with_name("0004-called-otherwise"))
    assert why(runs, 4, tmp_path / "models") == "ur5 v1 was fitted to it"
    assert moved.exists()


def test_recordings_of_one_name_are_told_apart_when_a_model_is_registered(
    runs: Path, tmp_path: Path
) -> None:
    from hil.models.model_registry import facts_of

    model = tmp_path / "model"
    model.mkdir()
    told = {"estimator": "x", "robot": {}, "training": {"sources": ["00.mcap"] * 2}}
    (model / "model.json").write_text(json.dumps(told))
    files = [run_number(runs, n) / "recording" / "00.mcap" for n in (1, 3)]
    facts = facts_of(model, [*files, run_number(runs, 6), run_number(runs, 4)])
    version(tmp_path / "models", facts)
    assert len(set(facts["data_sha256"].values())) == 4
    assert gone(runs, ALL, tmp_path / "models") == [2]
