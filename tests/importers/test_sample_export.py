"""Exported samples are those of the run, to the last bit, in every format."""

from __future__ import annotations

import builtins
import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from hil import api
from hil.arms.payload import Payload
from hil.cli.app import app
from hil.core.errors import DataError, HilError, PluginError, RecordingError
from hil.data.dataset import Dataset
from hil.importers import import_recording, load_map
from hil.importers.sample_export import export_data
from hil.importers.sources import load_source
from hil.planning.plan import LoadStep
from tests.support.report_runs import dwell_plan, fourier_plan, robot_facts, rows_of_plan, write_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two trajectories, a temperature that is not always known, and awkward numbers."""
    plan = fourier_plan(trajectories=2)
    rows = rows_of_plan(plan)
    rows["effort"][::7] *= np.pi * 1e-9
    rows["effort"][5:9] = np.array([5e-324, -0.0, 1 / 3, 1e5])[:, None]
    rows["temperature"][10:20] = np.nan
    robot = robot_facts() | {"gravity_m_s2": [0.0, 0.0, -9.81]}
    root = tmp_path_factory.mktemp("runs")
    return write_run(root, plan, rows=rows, robot=robot).path


@pytest.fixture(scope="module")
def data(run: Path) -> Dataset:
    return load_source(run)


def by_joint(data: Dataset, found: dict[str, Any], cells: Any) -> None:
    """Every number of a dataset against flat columns; `cells` makes numbers of a column."""
    units = {"effort": "a", "effort_target": "a", "temperature": "c", "qdd_target": "rad_s2"}
    assert {"q", "qd", "effort", "temperature"} <= data.columns.keys()
    assert same(cells(found["t_s"]), data["t"])
    for name in data.columns.keys() - {"t"}:
        unit = units.get(name, "rad_s" if name.startswith("qd") else "rad")
        for j in range(6):
            assert same(cells(found[f"{name}_{j + 1}_{unit}"]), data[name][:, j]), name


def same(a: np.ndarray, b: np.ndarray) -> bool:
    """Bit for bit; NaN is NaN."""
    a, b = np.ascontiguousarray(a), np.ascontiguousarray(b)
    known = ~np.isnan(b)
    bits = np.array_equal(a[known].view(np.int64), b[known].view(np.int64))
    return bits and bool(np.all(np.isnan(a[~known])))


def labelled(found: dict[str, Any], data: Dataset) -> None:
    series = data.series_index()
    kinds = np.array([one.kind for one in data.conditions])[series]
    trajectories = np.array([one.trajectory for one in data.conditions])[series]
    assert np.array_equal(np.asarray(found["series"], int), series)
    assert np.array_equal(np.asarray(found["kind"]), kinds)
    assert np.array_equal(np.asarray(found["trajectory"], int), trajectories)


def explained(about: dict[str, Any], run: Path, data: Dataset) -> None:
    stop = json.loads((run / "stop.json").read_text())
    assert about["run"]["uid"] == json.loads((run / "start.json").read_text())["uid"]
    assert about["recordings_sha256"]["00.mcap"] == stop["sha256"]["recording/00.mcap"]
    assert about["units"]["effort"] == "A"
    assert about["serial"] == "S-1"
    assert [one["id"] for one in about["series"]] == [one.id for one in data.conditions]
    assert about["series"][-1]["rows"][1] == len(data)


def test_csv_comes_back_bit_for_bit(run: Path, data: Dataset, tmp_path: Path) -> None:
    told = export_data(run, tmp_path / "a.csv")
    with (tmp_path / "a.csv").open(newline="") as file:
        header, *lines = csv.reader(file)
    assert header == told["columns"]
    found = {name: [line[i] for line in lines] for i, name in enumerate(header)}
    by_joint(data, found, lambda cells: np.array([float(x) if x else np.nan for x in cells]))
    assert found["temperature_1_c"].count("") == np.isnan(data["temperature"][:, 0]).sum() > 0
    labelled(found, data)
    explained(json.loads((tmp_path / "a.json").read_text()), run, data)


def test_npz_comes_back_bit_for_bit_without_pickle(
    run: Path, data: Dataset, tmp_path: Path
) -> None:
    export_data(run, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as found:
        assert {name for name in found if found[name].ndim == 2} == data.columns.keys() - {"t"}
        for name, values in data.columns.items():
            assert same(found[name], values)
        labelled(dict(found), data)
        explained(json.loads(str(found["hil"])), run, data)


def test_parquet_comes_back_bit_for_bit(run: Path, data: Dataset, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    export_data(run, tmp_path / "a.parquet")
    table = parquet.read_table(tmp_path / "a.parquet")
    found = {name: table[name].to_numpy() for name in table.column_names}
    by_joint(data, found, np.asarray)
    labelled(found, data)
    explained(json.loads(table.schema.metadata[b"hil"]), run, data)
    assert table.schema.field("effort_6_a").metadata == {b"unit": b"A"}
    assert table.schema.field("kind").metadata is None


def test_hil_imports_what_it_exported(run: Path, data: Dataset, tmp_path: Path) -> None:
    export_data(run, tmp_path / "a.csv")
    import_recording(tmp_path / "a.csv", map_file=tmp_path / "a.map.yaml", out=tmp_path / "b.mcap")
    again, before = load_source(tmp_path / "b.mcap"), data.of_kind("trajectory")
    for name in ("t", "q", "qd", "effort", "q_target"):
        assert np.array_equal(again[name], before[name]), name
    assert np.array_equal(again.offsets, before.offsets)
    assert [one.payload for one in again.conditions] == [one.payload for one in before.conditions]
    assert again.drive_gains is not None
    assert np.array_equal(again.drive_gains, [10.0] * 6)
    assert "temperature" not in again.columns  # it is not known in every row


def test_loads_come_back_window_by_window(tmp_path: Path) -> None:
    load = Payload(1.5, (0.0, 0.01, 0.05), (1e-3, 2e-3, 3e-3, 0.0, 0.0, 0.0))
    plan = replace(fourier_plan(trajectories=1), loads=(LoadStep(load),))
    run = write_run(tmp_path / "runs", plan).path
    export_data(run, tmp_path / "a.csv")
    import_recording(tmp_path / "a.csv", map_file=tmp_path / "a.map.yaml", out=tmp_path / "b.mcap")
    (condition,) = load_source(tmp_path / "b.mcap").conditions
    assert condition.payload == load


def test_a_serial_number_that_looks_like_a_number_is_text_in_the_map(tmp_path: Path) -> None:
    robot = robot_facts() | {"identity": {"serial": "12e4"}, "gravity_m_s2": [0.0, 0.0, -9.81]}
    run = write_run(tmp_path / "runs", fourier_plan(trajectories=1), robot=robot).path
    export_data(run, tmp_path / "a.csv")

    assert load_map(tmp_path / "a.map.yaml").serial == "12e4"


def test_of_dwells_there_is_no_map_and_it_is_told_why(tmp_path: Path) -> None:
    run = write_run(tmp_path / "runs", dwell_plan(poses=3)).path
    told = export_data(run, tmp_path / "a.csv")
    assert told["notes"] == [
        "no map for hil import: imported rows must be trajectories, and the samples contain none",
    ]
    assert not (tmp_path / "a.map.yaml").exists()
    with (tmp_path / "a.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {(row["kind"], row["approach"]) for row in rows} >= {("dwell", "1"), ("dwell", "-1")}


def test_a_recording_alone_can_be_exported(run: Path, tmp_path: Path) -> None:
    import_export = tmp_path / "a.csv"
    export_data(run, import_export)
    import_recording(import_export, map_file=tmp_path / "a.map.yaml", out=tmp_path / "b.mcap")
    told = export_data(tmp_path / "b.mcap", tmp_path / "b.npz")
    with np.load(tmp_path / "b.npz") as found:
        about = json.loads(str(found["hil"]))
    assert told["samples"] == about["series"][-1]["rows"][1]
    assert (about["run"], about["source"], about["serial"]) == (None, "b.mcap", "S-1")


def test_slips_are_told_and_nothing_is_written(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    imported = builtins.__import__

    def without_pyarrow(name: str, *more: Any, **kw: Any) -> Any:
        if name.startswith("pyarrow"):
            raise ImportError(name)
        return imported(name, *more, **kw)

    monkeypatch.setattr(builtins, "__import__", without_pyarrow)
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "a.map.yaml").write_text("mine")
    slips: list[tuple[Path, Path, type[HilError], str]] = [
        (run, tmp_path / "a.parqet", DataError, "did you mean '.parquet'?"),
        (run, tmp_path / "a", DataError, "has no known file name extension"),
        (run, tmp_path / "a.parquet", PluginError, "pyarrow"),
        (run, tmp_path / "there" / "a.csv", RecordingError, "a.map.yaml exists already"),
        (run, tmp_path / "missing" / "a.npz", RecordingError, "No such file"),
        (tmp_path / "no.mcap", tmp_path / "a.npz", DataError, "does not exist"),
    ]
    for source, out, kind, words in slips:
        with pytest.raises(kind) as caught:
            export_data(source, out)
        assert words in str(caught.value)
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["a.map.yaml"]


def test_the_command_and_the_api_say_what_was_written(run: Path, tmp_path: Path) -> None:
    arguments = ["export-data", str(run), "-o", str(tmp_path / "a.csv")]
    told = CliRunner().invoke(app, arguments).stdout.splitlines()
    assert told[0].endswith("samples of 4 series")
    assert told[1:] == [f"  {tmp_path / 'a.json'}", f"  {tmp_path / 'a.map.yaml'}"]
    document = api.export_data(run, tmp_path / "b.npz")
    arguments = ["export-data", run.name, "--runs", str(run.parents[2]), "--json"]
    again = CliRunner().invoke(app, [*arguments, "-o", str(tmp_path / "c.npz")])
    keys = ("samples", "series", "columns", "notes")
    assert {key: json.loads(again.stdout)[key] for key in keys} == {
        key: document[key] for key in keys
    }


def test_notes_of_the_command_are_wrapped_on_a_terminal(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.cli.output.out_width", lambda: 30)
    told_by_api = {"samples": 1, "series": 1, "files": ["a.csv"], "notes": ["word " * 12]}
    monkeypatch.setattr(api, "export_data", lambda *_: told_by_api)
    told = CliRunner().invoke(app, ["export-data", str(run), "-o", str(tmp_path / "a.csv")]).stdout
    notes = told.split("  note: ")[1].splitlines()
    assert len(notes) > 1
    assert max(map(len, notes)) <= 30
