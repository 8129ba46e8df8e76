"""Which model a verb means, and tables on narrow terminals."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from hil.cli.app import app
from hil.cli.output import fixed, print_table
from hil.cli.study import means
from hil.core.errors import DataError, RegistryError, SpecError
from hil.estimators import estimator, load_model_file, save_model
from hil.export.targets import written_as
from hil.runs import find_model
from hil.studies.result import Table
from tests.support.paths import EXPERIMENTS
from tests.support.synthetic_motion import moving, nominal


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run 1 has a model, run 2 none, run 3 two."""
    root = tmp_path_factory.mktemp("runs")
    model = estimator("rigid-wls").fit(moving(1, 2, 3), nominal())
    for number, names in ((1, ["a"]), (2, []), (3, ["a", "b"])):
        run = root / "2026-11-22" / "ur5" / f"000{number}-some"
        run.mkdir(parents=True)
        (run / "start.json").write_text("{}")
        for name in names:
            save_model(model, run / "fit" / name)
    return root


def run_of(runs: Path, number: int) -> Path:
    return runs / "2026-11-22" / "ur5" / f"000{number}-some"


@pytest.mark.parametrize("under", ["", "fit", "fit/a"])
def test_a_run_its_fits_and_the_folder_are_one_model(under: str, runs: Path) -> None:
    model = run_of(runs, 1) / "fit" / "a"
    assert find_model(str(run_of(runs, 1) / under), runs) == model
    assert load_model_file(str(run_of(runs, 1) / under)).joint_names_


def test_a_number_and_a_name_of_a_run_are_its_model(runs: Path) -> None:
    model = run_of(runs, 1) / "fit" / "a"
    assert find_model("1", runs) == model
    names = {str(path) for path in run_of(runs, 3).glob("fit/*")}
    with pytest.raises(DataError, match="contains 2 models") as told:
        find_model("3", runs)
    assert all(name in told.value.message for name in names)


def test_what_holds_no_model_says_what_to_give(runs: Path) -> None:
    cases = {
        "2": ("is a run without a model", "hil fit"),
        "9": ("no model folder 9", "hil runs"),
        str(run_of(runs, 1) / "fit/a/model.json"): ("is a file", "pass the folder of this file: "),
        str(runs / "nowhere"): ("does not exist", "name a folder such as"),
    }
    for given, (message, hint) in cases.items():
        with pytest.raises(DataError) as told:
            find_model(given, runs)
        assert message in told.value.message
        assert hint in told.value.hint


@pytest.mark.parametrize(
    ("to", "out", "words"),
    [
        ("c", "arm.c", "--to c writes a folder"),
        ("urdf", "y.json", "for example: --out y.urdf, or with --to json"),
        ("torch", "arm.onnx", "--to onnx"),
        ("onxx", "arm.onnx", "did you mean 'onnx'?"),
    ],
)
def test_slips_of_an_export_are_told(to: str, out: str, words: str, runs: Path) -> None:
    with pytest.raises(SpecError) as told:
        written_as(load_model_file(run_of(runs, 1)), Path(out), to)
    assert words in f"{told.value.message}; {told.value.hint}"
    assert not Path(out).exists()


def test_a_station_that_is_not_there_is_no_experiment(tmp_path: Path) -> None:
    (tmp_path / "nops.yaml").write_text("hil: 1\n")
    (tmp_path / "nopes.yaml").write_text("# a bench\nhil_station: 1\n")
    spec = str(EXPERIMENTS / "ci_dwell_12.yaml")
    done = CliRunner().invoke(app, ["plan", spec, "--station", str(tmp_path / "nop.yaml")])
    assert isinstance(done.exception, SpecError)
    assert done.exception.hint == f"did you mean {tmp_path / 'nopes.yaml'}?"


ROWS = [(f"mass {i} [kg·m²]", "1.23456", "0.00012", "1.23400 … 1.23500", "yes") for i in range(3)]
HEADER = ("parameter", "value", "± std", "95 % interval", "well determined")


@pytest.mark.parametrize("first", ["", "/a/path/that/is/longer/than/the/terminal/is/wide/at/all/"])
def test_tables_keep_to_the_columns_and_numbers_whole(
    first: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = [(first + name, *cells) for name, *cells in ROWS]
    monkeypatch.setenv("COLUMNS", "60")
    print_table(HEADER, rows)
    assert len(capsys.readouterr().out.splitlines()) == 4  # in a pipe they are as wide as they are
    monkeypatch.setattr("hil.cli.output.width_of", lambda stream: 60)
    print_table(HEADER, rows)
    lines = capsys.readouterr().out.splitlines()
    assert max(len(line) for line in lines if not (first and line.startswith("/"))) <= 60
    assert sum(len(re.findall(r"\b1\.23456\b", line)) for line in lines) == 3


def test_what_is_empty_is_not_told_where_a_table_comes_row_by_row(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.cli.output.width_of", lambda stream: 40)
    rows = [("2026-11-22 16:34:01", "started", "", "x" * 30), ("2026-11-22 16:34:02", "", "", "")]
    print_table(("when", "event", "occasion", "what"), rows)
    assert capsys.readouterr().out.splitlines() == [
        "2026-11-22 16:34:01", "  event: started, what:", f"    {'x' * 30}", "2026-11-22 16:34:02",
    ]  # fmt: skip


def narrow(monkeypatch: pytest.MonkeyPatch, columns: int = 50) -> None:
    monkeypatch.setattr("hil.cli.output.width_of", lambda stream: columns)


def test_words_at_the_end_of_rows_are_wrapped_in_their_column(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    narrow(monkeypatch, 40)
    print_table(
        ("kind", "what"), [("dwell", "gravity and friction from poses at rest"), ("a", "b")]
    )
    assert capsys.readouterr().out.splitlines() == [
        "kind   what",
        "dwell  gravity and friction from poses",
        "       at rest",
        "a      b",
    ]


def test_rows_stay_together_where_names_take_most_of_the_width(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    narrow(monkeypatch)
    rows = [("runs/2026-11-22/ur5/0001-ci-dwell-12", "completed", "1 min 41 s", "passed")]
    print_table(("run", "status", "duration", "verdict"), rows)
    assert capsys.readouterr().out.splitlines() == [
        "runs/2026-11-22/ur5/0001-ci-dwell-12",
        "  status: completed, duration: 1 min 41 s,",
        "    verdict: passed",
    ]


def test_rows_that_share_a_name_are_not_taken_apart(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    narrow(monkeypatch, 30)
    rows = [("drivers", name, "hil 0.1.0", "ok") for name in ("cia402", "mock")]
    print_table(("group", "name", "from", "state"), rows)
    told = capsys.readouterr().out.splitlines()
    assert told[:2] == ["drivers", "  name: cia402, from: hil"]


def test_rows_without_titles_are_lines(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    narrow(monkeypatch, 40)
    rows = [("steps", "93"), ("margin: robot_acceleration_rad_s2", "12.57 of 15 with these loads")]
    print_table(("", ""), rows)
    assert capsys.readouterr().out.splitlines() == [
        "steps  93",
        "margin: robot_acceleration_rad_s2  12.57",
        "  of 15 with these loads",
    ]


def test_zero_has_no_sign() -> None:
    assert [fixed(x, 3) for x in (-0.0001, 0.0, -0.002)] == ["0.000", "0.000", "-0.002"]


def test_a_terminal_gets_means_by_load_and_model() -> None:
    rows = tuple(
        (f"3 kg, beside, rigid-wls, {told}", 9.0, mean)
        for told, mean in (("unaware", 5.0), ("declared", 1.0))
    )
    table = means(Table("table-load-errors", "RMSE", ("load", "J1", "mean"), rows))
    assert table.columns == ("load, model", "unaware", "declared")
    assert table.rows == (("3 kg, beside, rigid-wls", 5.0, 1.0),)


def test_a_single_column_wider_than_the_terminal_is_wrapped(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    narrow(monkeypatch, 20)
    print_table(["run"], [["a/" + "b" * 30], ["words of more than twenty"], ["c"]])
    told = ["run", "a/" + "b" * 30, "words of more than", "  twenty", "c"]
    assert capsys.readouterr().out.splitlines() == told


def invoke(*words: str) -> Result:
    return CliRunner().invoke(app, list(words))


@pytest.mark.thorough
def test_the_first_champion_needs_no_recording_and_is_exported_by_name(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = str(run_of(runs, 1) / "fit" / "a")
    done = invoke("models", "register", folder, "--name", "ur5")
    assert "make it champion: hil models promote ur5 v1\n" in done.stdout

    early = invoke("export", "ur5", "--to", "json", "-o", "m.json").exception
    assert isinstance(early, RegistryError)
    limited = invoke("models", "promote", "ur5", "v1", "--max-rmse", "1").exception
    assert isinstance(limited, SpecError)

    done = invoke("models", "promote", "ur5", "v1")
    assert "ur5: v1 is champion: there is no other champion" in done.stdout
    again = invoke("models", "promote", "ur5", "v1").exception
    assert isinstance(again, SpecError)
    assert "a recording is required" in again.message

    assert invoke("export", "ur5", "--to", "json", "-o", "m.json").exit_code == 0
    assert Path("m.json").is_file()
    assert isinstance(invoke("export", "ur6", "-o", "x").exception, DataError)
