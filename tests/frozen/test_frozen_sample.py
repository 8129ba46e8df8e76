"""What revision 48f2337 has written is opened, resumed, reported, promoted and exported as ever.

`sample.tar.xz` holds run directories, models, a registry, a schedule, a fleet, exports and the
documents of commands, all written by that revision (how: `make_sample.py` in it). It is never
adapted to newer code: a test that fails here says that existing files or scripts no longer work.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file

import hil
from hil.core import plugins
from hil.estimators import load_model_file
from hil.importers.sources import load_source
from hil.recording import read_topic
from tests.frozen.frozen_parts import (
    HERE,
    command,
    differences,
    layout,
    missing,
    parsed,
    run_of,
    told,
)

RUNS = {
    "frozen-dwell": "completed", "frozen-fourier": "completed", "frozen-other": "completed",
    "frozen-probe": "completed", "frozen-tool": "completed", "frozen-loads": "completed",
    "frozen-ur": "completed", "frozen-can": "completed", "frozen-plc": "completed",
    "frozen-passive": "completed", "frozen-cut": "interrupted", "frozen-unreported": "completed",
    "frozen-campaign": "completed", "frozen-fleet": "completed",
}  # fmt: skip
"""Experiments of the sample by how their newest run stands."""

ESTIMATORS = {
    "static-wls": "frozen-dwell", "static-linear": "frozen-dwell", "static-inverse": "frozen-dwell",
    "static-mlp-lm": "frozen-dwell", "static-coulomb": "frozen-dwell",
    "static-hysteresis": "frozen-dwell", "rigid-wls": "frozen-fourier",
    "rigid-linear": "frozen-fourier", "rigid-lmi": "frozen-fourier", "rigid-irls": "frozen-fourier",
    "rigid-diffnea": "frozen-fourier", "rigid-hysteresis": "frozen-fourier",
    "lagrangian": "frozen-fourier", "residual": "frozen-fourier",
}  # fmt: skip
"""Every estimator of that revision, and the run that its model was fitted to."""

LINEAR = (
    "static-wls", "static-linear", "static-coulomb", "static-hysteresis", "static-inverse",
    "rigid-wls", "rigid-linear", "rigid-lmi", "rigid-irls",
)  # fmt: skip

EXPORTS = {
    "c": ("rigid-wls", "c", "arm"),
    "c-memory": ("rigid-hysteresis", "c", "arm"),
    "c-residual": ("residual", "c", "arm"),
    "onnx": ("rigid-wls", "onnx", "arm.onnx"),
    "torch": ("lagrangian", "torch", "arm.pt2"),
    "onnx-mlp": ("static-mlp-lm", "onnx-mlp", "arm.onnx"),
    "urdf": ("rigid-lmi", "urdf", "arm.urdf"),
    "json": ("rigid-linear", "json", "arm.json"),
}
"""Exports of the sample: the model, the target and the file."""


# --- runs ---


def test_every_run_is_listed_as_it_was(shared: Path) -> None:
    was = json.loads((shared / "json/runs.json").read_text("utf-8"))
    same = ("run", "uid", "status", "robot", "date", "verdict", "duration_s", "problem")
    assert [[run[key] for key in same] for run in told("runs")] == [
        [run[key] for key in same] for run in was
    ]


@pytest.mark.parametrize("name", RUNS)
def test_a_run_opens(name: str, shared: Path) -> None:
    run = run_of(shared, name)
    shown = told("show", name)
    assert shown["status"] == RUNS[name]
    assert shown["start"]["uid"] == json.loads((run / "start.json").read_text("utf-8"))["uid"]
    rows = sum(len(read_topic(f, salvage=True)) for f in (run / "recording").iterdir())
    if shown["stop"]:
        assert shown["stop"]["samples"] == rows
        assert told("show", name, "--verify")["problems"] == []
    data = load_source(run)
    assert 0 < len(data) <= rows
    assert np.isfinite(data["effort"]).all()


@pytest.mark.parametrize("name", RUNS)
def test_a_run_has_a_report(name: str, shared: Path) -> None:
    run = run_of(shared, name)
    page = Path(told("report", run)["report"])
    assert name in page.read_text("utf-8")


def test_a_run_that_was_cut_off_goes_on(lab: Path) -> None:
    run = run_of(lab, "frozen-cut")
    torn = run / "recording/00.mcap.partial"
    before = torn.read_bytes()
    done = told("resume", run)
    assert done["outcome"] == "completed"
    assert torn.read_bytes() == before
    assert told("show", run)["stop"]["complete"]["dwell"] == {"done": 16, "of": 16}
    dwells = load_source(run, kinds=("dwell",))
    assert len({(c.pose, c.approach) for c in dwells.conditions}) == 16


def test_a_torn_recording_is_made_whole(lab: Path) -> None:
    run = run_of(lab, "frozen-cut")
    torn = read_topic(run / "recording/00.mcap.partial", salvage=True)
    (file,) = told("recover", run)["files"]
    assert file["did"] in ("rebuilt", "renamed")
    assert read_topic(run / "recording/00.mcap").tobytes() == torn.tobytes()


def test_a_run_that_was_killed_before_its_report_gets_one(lab: Path) -> None:
    run = run_of(lab, "frozen-unreported")
    models = sorted(f.name for f in (run / "fit").iterdir())
    assert not (run / "report.html").exists()
    done = told("resume", run)
    assert (done["outcome"], done["verdict"]) == ("completed", "passed")
    assert (run / "report.html").stat().st_size > 100_000
    assert sorted(f.name for f in (run / "fit").iterdir()) == models


def test_the_same_spec_is_the_same_plan(shared: Path) -> None:
    """Also for a run on the wire: its plan was made from where the arm stood."""
    for name in ("dwell", "fourier", "loads"):
        was = json.loads((run_of(shared, f"frozen-{name}") / "plan.json").read_text("utf-8"))
        experiment = hil.load(f"specs/{name}.yaml", station="specs/bench.yaml")
        now = json.loads(json.dumps(hil.plan(experiment).to_dict()))
        assert differences(was["steps"], now["steps"]) == []


def test_a_new_recording_has_the_topics_and_schemas_of_the_old_one(lab: Path) -> None:
    was = run_of(lab, "frozen-fourier")
    told("run", "specs/fourier.yaml", "--station", "specs/bench.yaml")
    now = run_of(lab, "frozen-fourier")
    assert was != now
    assert layout(now / "recording/00.mcap") == layout(was / "recording/00.mcap")
    rows = read_topic(was / "recording/00.mcap")
    assert read_topic(now / "recording/00.mcap").dtype == rows.dtype
    assert {f.name for f in now.iterdir()} - {"report.html"} == {f.name for f in was.iterdir()}


@pytest.mark.parametrize("name", ["fourier", "loads"])
def test_a_new_run_directory_has_the_files_and_keys_of_the_old_one(name: str, lab: Path) -> None:
    was = run_of(lab, f"frozen-{name}")
    told("run", f"specs/{name}.yaml", "--station", "specs/bench.yaml")
    now = run_of(lab, f"frozen-{name}")
    assert was != now
    old, new = documents_in(was), documents_in(now)
    assert set(old) <= set(new)
    for file in old:
        assert missing(by_kind(old[file]), by_kind(new[file]), file) == []


def documents_in(run: Path) -> dict[str, Path]:
    """The documents of a run directory; digests of models and studies hang on rounding."""
    found = (f for f in files(run) if f.suffix in (".json", ".jsonl"))
    return {re.sub(r"-[0-9a-f]{12}", "", str(f.relative_to(run))): f for f in found}


def by_kind(path: Path) -> Any:
    """The document of a file; of lines all those of a kind together."""
    document = parsed(path.read_text("utf-8"))
    if path.suffix == ".json":
        return document
    kinds: dict[str, list[Any]] = {}
    for line in document:
        kinds.setdefault(str(line.get("kind", line.get("event"))), []).append(line)
    return kinds


# --- models ---


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_model_predicts_what_it_predicted(name: str, shared: Path) -> None:
    golden = np.load(shared / "golden/predictions.npz")
    seen = load_source(run_of(shared, ESTIMATORS[name]))
    predicted = load_model_file(shared / "models" / name).predict(seen)
    rows, effort = golden[f"{name}/rows"], golden[f"{name}/effort"]
    # Networks add in single precision, each processor in an order of its own.
    atol = 1e-6 * np.abs(effort).max()
    np.testing.assert_allclose(predicted.effort[rows], effort, rtol=1e-6, atol=atol)
    assert np.array_equal(predicted.valid[rows], golden[f"{name}/valid"])
    parts = {key.rpartition("/")[2] for key in golden.files if key.startswith(f"{name}/part/")}
    assert set(predicted.components) == parts
    for part in parts:
        np.testing.assert_allclose(
            predicted.components[part][rows], golden[f"{name}/part/{part}"], rtol=1e-6, atol=atol
        )


def test_there_is_a_model_of_every_estimator(shared: Path) -> None:
    """One that has come since needs none."""
    assert set(ESTIMATORS) <= set(plugins.names("hil.estimators"))
    assert {f.name for f in (shared / "models").iterdir()} >= set(ESTIMATORS)


@pytest.mark.parametrize("name", LINEAR)
def test_a_linear_fit_finds_the_same_parameters(name: str, lab: Path) -> None:
    old = lab / "models" / name
    parameters = json.loads((old / "model.json").read_text("utf-8"))["parameters"]
    settings = [f"--set={key}={json.dumps(value)}" for key, value in parameters.items()
                if value is not None]  # fmt: skip
    new = told("fit", run_of(lab, ESTIMATORS[name]), "-e", name, *settings, "-o", "again")["model"]
    was, now = load_file(old / "model.safetensors"), load_file(Path(new) / "model.safetensors")
    assert set(was) <= set(now)
    for array in was:
        scale = np.nanmax(np.abs(was[array]), initial=0.0)
        np.testing.assert_allclose(now[array], was[array], rtol=1e-6, atol=1e-6 * scale)


# --- registry, schedule, fleet ---


def test_the_registry_is_adopted(lab: Path) -> None:
    listed = {m["name"]: m for m in told("models", "list")["models"]}
    assert (listed["ur5"]["champion"], listed["ur5"]["challenger"]) == (1, 3)
    assert listed["ur5"]["versions"] == 3
    assert {"ur5-001", "ur5-002"} <= set(listed)
    events = [entry["event"] for entry in told("models", "log", "ur5")["log"]]
    assert "rolled-back" in events
    told("models", "check")


def test_the_challenger_is_promoted_and_taken_back(lab: Path) -> None:
    probe = run_of(lab, "frozen-probe")
    was = json.loads((lab / "json/models-promote.json").read_text("utf-8"))["comparison"]
    promoted = told("models", "promote", "ur5", "--on", probe, "--unless-worse")
    assert promoted["promoted"]
    assert promoted["instead_of"] == "v1"
    assert promoted["comparison"]["challenger_rmse"] == pytest.approx(
        was["challenger_rmse"], rel=1e-6
    )
    back = told("models", "rollback", "ur5", "--reason", "as it was")
    assert back["champion"] == 1


def test_a_new_version_and_its_log_have_the_keys_of_old_ones(lab: Path) -> None:
    home = lab / "registry/ur5"
    old_log, old = by_kind(home / "log.jsonl"), by_kind(home / "v0003/version.json")
    shutil.rmtree(home)
    told("models", "register", lab / "models/rigid-lmi", "--name", "ur5", "--challenger")
    assert missing(old, by_kind(home / "v0001/version.json")) == []
    for event, lines in by_kind(home / "log.jsonl").items():
        assert missing(old_log[event], lines) == []


def test_a_schedule_goes_on_in_the_middle_of_its_occasion(lab: Path) -> None:
    """An occasion names its runs by absolute path, so the copy's are put there first."""
    (folder,) = (lab / "schedules/weekly/occasions").iterdir()
    stage = folder / "stages/campaign.json"
    kept = json.loads(stage.read_text("utf-8"))
    campaign = run_of(lab, "frozen-campaign")
    kept["document"]["run"] = str(campaign)
    text = json.dumps(kept["document"], sort_keys=True, separators=(",", ":"))
    kept["document_sha256"] = hashlib.sha256(text.encode()).hexdigest()
    stage.write_text(json.dumps(kept), "utf-8")
    assert told("schedule", "show", "specs/weekly.yaml")["open"]

    code, _ = command("schedule", "run", "specs/weekly.yaml", "--once")

    assert code == 0
    lines = told("schedule", "show", "specs/weekly.yaml")["lines"]
    mine = [line for line in lines if line.get("occasion") == folder.name]
    assert [line["event"] for line in mine] == ["begun", "begun", "done"]
    assert run_of(lab, "frozen-campaign") == campaign  # it was not made again
    registered = {m["name"]: m for m in told("models", "list")["models"]}
    assert registered["ur5-weekly"]["champion"] == 1


def test_a_fleet_opens(lab: Path) -> None:
    (folder,) = lab.glob("runs/*/fleet/fleet-frozen-fleet")
    done = told("fleet", "resume", folder)
    assert [(r["robot"], r["verdict"]) for r in done["robots"]] == [
        ("ur5-001", "passed"), ("ur5-002", "passed"),
    ]  # fmt: skip
    assert done["left"] == []
    report = told("fleet", "report", folder)
    assert [r["robot"] for r in report["robots"]] == ["ur5-001", "ur5-002"]
    assert Path(report["page"]).is_file()


# --- exports and imports ---


@pytest.mark.parametrize("name", EXPORTS)
def test_an_export_is_the_same(name: str, lab: Path) -> None:
    """The same but for prose and the last digits of numbers, which depend on the BLAS."""
    model, target, file = EXPORTS[name]
    told("export", lab / "models" / model, "--to", target, "-o", lab / "again" / file)
    was = {f.relative_to(lab / "exports" / name): f for f in files(lab / "exports" / name)}
    now = {f.relative_to(lab / "again"): f for f in files(lab / "again")}
    assert set(now) == set(was)
    for path, one in was.items():
        if now[path].read_bytes() != one.read_bytes():
            same = {".onnx": same_graph, ".pt2": same_program}.get(path.suffix, same_text)
            same(now[path], one)


def files(folder: Path) -> list[Path]:
    return [f for f in folder.rglob("*") if f.is_file()]


NUMBER = re.compile(r"-?\d+\.\d+(?:e[-+]?\d+)?|-?\d+e[-+]?\d+")
COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.DOTALL)
STRING = re.compile(r'"(?:[^"\\\n]|\\.)*"')


def without_prose(text: str) -> str:
    """The text without comments and without strings of several words."""
    return STRING.sub(lambda one: "" if " " in one[0] else one[0], COMMENT.sub("", text))


def same_text(new: Path, old: Path) -> None:
    """Equal but for prose and rounding of numbers with a fraction."""
    texts = [without_prose(path.read_text("utf-8")) for path in (new, old)]
    words = [NUMBER.sub("#", text).splitlines() for text in texts]
    assert words[0] == words[1]
    numbers = [np.array([float(n) for n in NUMBER.findall(text)]) for text in texts]
    np.testing.assert_allclose(*numbers, rtol=1e-6, atol=1e-9)


def same_graph(new: Path, old: Path) -> None:
    """ONNX graphs with the same nodes and, but for rounding, the same constants."""
    import onnx
    from onnx.numpy_helper import to_array

    graphs = [onnx.load(path).graph for path in (new, old)]
    nodes = [[(n.op_type, *n.input, *n.output) for n in graph.node] for graph in graphs]
    assert nodes[0] == nodes[1]
    assert [v.SerializeToString() for v in (*graphs[0].input, *graphs[0].output)] == [
        v.SerializeToString() for v in (*graphs[1].input, *graphs[1].output)
    ]
    constants = [{c.name: to_array(c) for c in graph.initializer} for graph in graphs]
    assert set(constants[0]) == set(constants[1])
    for name, values in constants[1].items():
        np.testing.assert_allclose(constants[0][name], values, rtol=1e-9, atol=1e-12)


def same_program(new: Path, old: Path) -> None:
    """PyTorch programs with the same code and state; their traces name files of the exporter."""
    import torch

    programs = [torch.export.load(path) for path in (new, old)]
    assert programs[0].graph_module.code == programs[1].graph_module.code
    states = [program.state_dict for program in programs]
    assert set(states[0]) == set(states[1])
    for name, values in states[1].items():
        torch.testing.assert_close(states[0][name], values, rtol=1e-9, atol=1e-12)


def test_samples_are_written_for_others_as_they_were(lab: Path) -> None:
    told("export-data", run_of(lab, "frozen-can"), "-o", "can.csv")
    for name in ("can.csv", "can.map.yaml"):
        assert (lab / name).read_bytes() == (lab / "exports/data" / name).read_bytes()


def test_an_import_map_gives_the_same_samples(lab: Path) -> None:
    told("import", "maps/log.csv", "--map", "maps/recorder.yaml", "-o", "again.mcap")
    assert read_topic(lab / "again.mcap").tobytes() == read_topic(lab / "imported.mcap").tobytes()
    was, now = load_source(lab / "imported.mcap"), load_source(lab / "again.mcap")
    assert [(c.kind, c.trajectory, c.load, c.payload) for c in now.conditions] == [
        (c.kind, c.trajectory, c.load, c.payload) for c in was.conditions
    ]
    assert layout(lab / "again.mcap") == layout(lab / "imported.mcap")


# --- plug-ins ---


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The laboratory's plug-ins, as pip would have installed them."""
    source, site = HERE / "plugin", tmp_path / "site"
    project = tomllib.loads((source / "pyproject.toml").read_text("utf-8"))["project"]
    shutil.copytree(source / "lab_plugins", site / "lab_plugins")
    info = site / "lab_plugins-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n", "utf-8"
    )
    groups = [
        "\n".join([f"[{group}]", *(f"{name} = {target}" for name, target in points.items())])
        for group, points in project["entry-points"].items()
    ]
    (info / "entry_points.txt").write_text("\n\n".join(groups) + "\n", "utf-8")
    monkeypatch.syspath_prepend(site)
    for name in [name for name in sys.modules if name.startswith("lab_plugins")]:
        monkeypatch.delitem(sys.modules, name)


STATION = """\
hil_station: 1
robots:
  arm: {driver: lab-arm, model: ur5e, options: {offset_nm: 2}}
"""
SPEC = """\
hil: 1
name: plugged
robot: arm
excitation: {kind: dwell, waypoints: 4, dwell_s: 0.1, samples_per_dwell: 4, approach: free, seed: 1}
warm_up: {duration_s: 0}
reference: {every: 0}
interlocks: [{kind: lab-power, limit_w: %s}]
fit: [{estimator: lab-gravity, shrink: 1.0}]
validate: {hold_out: {poses_percent: 25}}
accept: {rmse: {max: 0.001, unit: N·m, per: joint}}
"""


@pytest.fixture
def plugged(installed: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a spec that uses them, which is the working directory."""
    monkeypatch.chdir(tmp_path)
    Path("station.yaml").write_text(STATION, "utf-8")
    Path("spec.yaml").write_text(SPEC % 150, "utf-8")
    return tmp_path


def test_plug_ins_of_others_are_found_and_load(installed: None) -> None:
    theirs = [p for p in told("plugins") if p["distribution"] == "lab-plugins 1.0"]
    assert {p["name"] for p in theirs} == {"lab-arm", "lab-gravity", "lab-nudge", "lab-power"}
    assert [p["error"] for p in theirs] == [""] * 4


def test_an_experiment_runs_with_plug_ins_alone(plugged: Path) -> None:
    done = told("run", "spec.yaml")
    assert (done["outcome"], done["verdict"]) == ("completed", "passed")
    (model,) = done["models"]
    assert load_model_file(model).coefficients_[1] == pytest.approx(5.0, abs=1e-3)


def test_an_interlock_of_others_stops_a_run(plugged: Path) -> None:
    Path("spec.yaml").write_text(SPEC % 0.001, "utf-8")
    code, out = command("run", "spec.yaml", "--json")
    assert code == 5
    assert "lab-power" in json.loads(out)["error"]["message"]


def test_an_excitation_of_others_is_planned(plugged: Path) -> None:
    """A spec cannot name it yet; a plan of Python can."""
    experiment = hil.load("spec.yaml")
    nudged = experiment.spec.excitation.model_copy(update={"kind": "lab-nudge"})
    spec = experiment.spec.model_copy(update={"excitation": nudged})
    plan = hil.plan(replace(experiment, spec=spec))
    assert sum(step.kind == "dwell" for step in plan.steps) == 4
