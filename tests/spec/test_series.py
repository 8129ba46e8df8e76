"""Series files: what is wrong with them, with file, line and column, and with what they name."""

from __future__ import annotations

from pathlib import Path

import pytest

from hil.core.errors import SpecError
from hil.spec import load_spec
from hil.spec.series import is_series, load_series_spec
from hil.workflow.series import load_series
from tests.support.paths import EXPERIMENTS

SPEC = """
hil: 1
name: small
robot: ur5
excitation: {kind: dwell, waypoints: 4}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "small.yaml").write_text(SPEC, "utf-8")
    return tmp_path


def written(folder: Path, text: str) -> Path:
    path = folder / "series.yaml"
    path.write_text("hil_series: 1\nname: all\n" + text, "utf-8")
    return path


def refusal(path: Path) -> list[str]:
    with pytest.raises(SpecError) as caught:
        load_series(path)
    return str(caught.value.message).splitlines()


def test_paths_start_at_the_folder_of_the_series(folder: Path) -> None:
    path = written(folder, "series: [{spec: small.yaml}]\n")
    assert load_series_spec(path).series[0].spec == str((folder / "small.yaml").resolve())


def test_the_station_is_the_one_named_last_before_the_run(folder: Path) -> None:
    mock, fast = EXPERIMENTS / "stations" / "mock.yaml", EXPERIMENTS / "stations" / "mock_1khz.yaml"
    entries = f"[{{spec: small.yaml}}, {{spec: small.yaml, station: {fast}}}]"
    path = written(folder, f"station: {mock}\nseries: {entries}\n")
    assert [e.station_source for e in load_series(path).experiments] == [str(mock), str(fast)]
    named = load_series(path, fast).experiments
    assert {experiment.station_source for experiment in named} == {str(fast)}


def test_a_file_that_is_missing_is_told_with_its_place_and_a_guess(folder: Path) -> None:
    path = written(folder, "series:\n  - {spec: smal.yaml}\n")
    (line,) = refusal(path)
    assert line.startswith(f"{path}:4:12: series.0.spec: there is no file")
    assert line.endswith(f"did you mean {folder}/small.yaml?")


def test_everything_that_is_wrong_is_told_at_once(folder: Path) -> None:
    path = written(folder, "seires: []\nseries:\n  - {spec: none.yaml, sation: a.yaml}\n")
    told = refusal(path)
    assert any("3:1: seires: unknown key; did you mean 'series'?" in line for line in told)
    assert any("sation: unknown key; did you mean 'station'?" in line for line in told)
    assert any("series.0.spec: there is no file" in line for line in told)


def test_what_is_wrong_with_any_experiment_is_told_with_that_file(folder: Path) -> None:
    for name in ("one", "two"):
        (folder / f"{name}.yaml").write_text(SPEC.replace("dwell", f"dwel_{name}"), "utf-8")
    told = refusal(written(folder, "series: [{spec: one.yaml}, {spec: two.yaml}]\n"))
    assert [Path(line.partition(":")[0]).name for line in told] == ["one.yaml", "two.yaml"]


def test_a_series_of_nothing_is_none(folder: Path) -> None:
    assert "must not be empty" in refusal(written(folder, "series: []\n"))[0]


def test_a_series_is_told_from_an_experiment(folder: Path) -> None:
    path = written(folder, "series: [{spec: small.yaml}]\n")
    assert is_series(path)
    assert not is_series(folder / "small.yaml")
    assert not is_series(folder / "missing.yaml")
    with pytest.raises(SpecError, match="this file is a series of experiments, but an experiment"):
        load_spec(path)
    with pytest.raises(SpecError, match="this file is an experiment, but a series"):
        load_series_spec(folder / "small.yaml")


@pytest.mark.parametrize(
    "path",
    [path for path in sorted(EXPERIMENTS.glob("*.yaml")) if is_series(path)],
    ids=lambda path: path.stem,
)
def test_every_shipped_series_runs_on_mocks(path: Path) -> None:
    series = load_series(path)
    assert {each.robot.driver for each in series.experiments} == {"mock"}
    assert series.spec.name == path.stem.replace("_", "-")


def test_a_series_that_names_itself_is_no_experiment(folder: Path) -> None:
    (line,) = refusal(written(folder, "series: [{spec: series.yaml}]\n"))
    assert "series.yaml:3:17: series.0.spec: " in line
    assert line.endswith("series.yaml is a series of experiments, but an experiment is needed here")


def test_a_missing_file_and_files_of_another_kind_are_told_at_once_by_line(folder: Path) -> None:
    mock = EXPERIMENTS / "stations" / "mock.yaml"
    entries = ("none.yaml", "series.yaml", f"small.yaml, station: {folder / 'small.yaml'}", mock)
    path = written(folder, "series:\n" + "".join(f"  - {{spec: {one}}}\n" for one in entries))
    missing, nested, station, spec = refusal(path)
    assert "series.0.spec: there is no file" in missing
    assert "series.yaml:5:12: series.1.spec: " in nested
    assert station.endswith("small.yaml is an experiment, but a station is needed here")
    assert spec.endswith("mock.yaml is a station, but an experiment is needed here")


def test_no_list_of_keys_is_pointed_at_where_a_file_name_is_wrong(folder: Path) -> None:
    known = "`hil explain series"
    for entry, hint in (("spec: none.yaml", ""), ("spec: small.yaml, to: 1", known)):
        with pytest.raises(SpecError) as caught:
            load_series(written(folder, f"series: [{{{entry}}}]\n"))
        assert (caught.value.hint or "")[: len(known)] == hint


def test_a_key_that_is_nothing_like_the_known_ones_is_no_slip_of_one(folder: Path) -> None:
    (line,) = refusal(written(folder, "series: [{spec: small.yaml, rate: 1}]\n"))
    assert "did you mean" not in line


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"hil_series: 1\nname: \xff\n", "f.yaml:2:7: byte 0xff is not UTF-8"),
        (b"hil_series: 2\nname: a\nseries: []\n", "reads format 1, not 2"),
        (
            b"hil_series: 1\nname: a\nseries: [{spec: x, to: 1}]\n",
            "series.0.to: unknown key",
        ),
        (b"hil_series: 1\nname: a\nseries: &a [*a]\n", "an alias contains itself"),
        (b"", "the file is empty"),
    ],
)
def test_what_is_no_series_is_told_by_line(folder: Path, content: bytes, words: str) -> None:
    path = folder / "f.yaml"
    path.write_bytes(content)
    assert words in "\n".join(refusal(path))
