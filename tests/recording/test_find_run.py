"""What people may call a run on the command line."""

from __future__ import annotations

from pathlib import Path

import pytest

from hil.core.errors import DataError
from hil.runs.listing import find_run


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    for day, name in (("2026-11-20", "0007-dwell"), ("2026-11-21", "0042-fourier")):
        run = tmp_path / "runs" / day / "ur5" / name
        (run / "recording").mkdir(parents=True)
        (run / "start.json").write_text("{}")
        (run / "recording" / "00.mcap").write_bytes(b"")
    return tmp_path / "runs"


@pytest.mark.parametrize("named", ["42", "0042", "0042-fourier"])
def test_a_run_is_found_by_number_and_by_name(named: str, runs: Path) -> None:
    assert find_run(named, runs) == runs / "2026-11-21" / "ur5" / "0042-fourier"


def test_a_path_is_taken_as_it_is(runs: Path) -> None:
    path = runs / "2026-11-20" / "ur5" / "0007-dwell"
    assert find_run(str(path), Path("elsewhere")) == path


def test_an_unknown_number_says_how_to_list_the_runs(runs: Path) -> None:
    with pytest.raises(DataError, match="there is no run 3") as caught:
        find_run("3", runs)
    assert caught.value.hint == f"list them with: hil runs --runs {runs}"


def test_a_misspelt_name_comes_with_a_guess(runs: Path) -> None:
    with pytest.raises(DataError) as caught:
        find_run("0042-furier", runs)
    assert "'0042-fourier'" in caught.value.hint


def test_two_runs_of_one_number_need_the_path(runs: Path) -> None:
    (runs / "2026-11-21" / "ur10" / "0042-copy").mkdir(parents=True)
    with pytest.raises(DataError, match="2 runs are called 42") as caught:
        find_run("42", runs)
    assert caught.value.hint == "use the path"


def test_the_recording_of_a_run_leads_to_its_run(runs: Path) -> None:
    run = runs / "2026-11-20" / "ur5" / "0007-dwell"
    with pytest.raises(DataError, match="is a recording, not a run directory") as caught:
        find_run(str(run / "recording" / "00.mcap"), runs)
    assert caught.value.hint.endswith(f"hil show {run}")


def test_any_other_recording_leads_to_a_fit(tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(b"")
    with pytest.raises(DataError, match="is a recording") as caught:
        find_run(str(tmp_path / "x.mcap"), tmp_path)
    assert "hil fit" in caught.value.hint
