"""The ledger: what is written is there for good, and one process keeps it."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import pytest

from hil.core.errors import DataError, RecordingError
from hil.maintenance.ledger import LEDGER_FILE, Ledger, Occasion, occasion_of, open_ledger
from tests.support.schedule_parts import MONDAY, at


def three_lines(folder: Path) -> Path:
    with open_ledger(folder, "nightly") as ledger:
        ledger.start("nightly", MONDAY)
        ledger.add("begun", MONDAY, occasion="20261123T000000Z-probe", until=MONDAY.isoformat())
        ledger.add("done", MONDAY, occasion="20261123T000000Z-probe", result={"text": "well"})
    return folder / LEDGER_FILE


def test_it_is_read_as_it_was_written(tmp_path: Path) -> None:
    three_lines(tmp_path)
    read = Ledger.read(tmp_path)
    assert [line["event"] for line in read.lines] == ["started", "begun", "done"]
    assert (read.standing.anchor, read.standing.until) == (MONDAY, MONDAY)
    assert read.standing.open is None


def test_what_work_says_may_be_anything_that_json_has_a_word_for(tmp_path: Path) -> None:
    with open_ledger(tmp_path, "nightly") as ledger:
        ledger.start("nightly", MONDAY)
        odd = {"rmse": float("nan"), "text": "\udc80 Größe", "run": tmp_path, "of": (1, 2)}
        line = ledger.add("failed", MONDAY, occasion="20261123T000000Z-probe", result=odd)
        ledger.add("failed", MONDAY, occasion="20261123T000000Z-probe")
    assert Ledger.read(tmp_path).lines[1] == line
    assert line["result"]["rmse"] is None


def test_a_torn_line_is_none_and_is_written_over(tmp_path: Path) -> None:
    path = three_lines(tmp_path)
    path.write_bytes(path.read_bytes()[:-7])
    with open_ledger(tmp_path, "nightly") as ledger:
        assert ledger.standing.begun
        ledger.add("failed", MONDAY, occasion="20261123T000000Z-probe", why="", kind="", hint="")
    assert [line["event"] for line in Ledger.read(tmp_path).lines] == ["started", "begun", "failed"]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda raw: raw.replace(b'"until"', b'"untie"'), "does not follow the line before"),
        (lambda raw: raw.replace(b"-probe", b"-prude"), "damaged"),
        (lambda raw: raw.replace(b"{", b"[", 1), "damaged"),
        (lambda raw: b"\n".join([*raw.split(b"\n")[:1], *raw.split(b"\n")[2:]]), "does not follow"),
    ],
)
def test_what_was_changed_is_found(tmp_path: Path, change: object, told: str) -> None:
    path = three_lines(tmp_path)
    path.write_bytes(change(path.read_bytes()))  # type: ignore[operator]
    with pytest.raises(DataError, match=told) as error:
        Ledger.read(tmp_path)
    assert str(path) in error.value.message


def test_one_process_keeps_it(tmp_path: Path) -> None:
    with open_ledger(tmp_path, "nightly"):
        with (
            pytest.raises(DataError, match="is run by pid") as error,
            open_ledger(tmp_path, "nightly"),
        ):
            pass
        assert "hil schedule show" in error.value.hint
    with open_ledger(tmp_path, "nightly"):
        pass


def test_it_is_of_one_schedule(tmp_path: Path) -> None:
    three_lines(tmp_path)
    with (
        open_ledger(tmp_path, "weekly") as ledger,
        pytest.raises(DataError, match="'nightly', not of"),
    ):
        ledger.start("weekly", MONDAY)


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(RecordingError, match="cannot make"),
        open_ledger(tmp_path / "file" / "a", "n"),
    ):
        pass


def test_in_memory_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    ledger = Ledger()
    ledger.start("nightly", MONDAY)
    ledger.folder_of(Occasion(MONDAY, "probe"))
    assert list(tmp_path.iterdir()) == []


def test_an_occasion_is_told_by_its_id() -> None:
    occasion = Occasion(at("23 03:00"), "campaign")
    assert occasion_of(occasion.id) == occasion
    for wrong in ("", "20261123T030000Z", "20261123T030000Z-fit", "today-probe"):
        with pytest.raises(ValueError, match=r".+"):
            occasion_of(wrong)


def test_lines_are_strict_json_with_utc_times(tmp_path: Path) -> None:
    for line in three_lines(tmp_path).read_text().splitlines():
        told = json.loads(line)
        assert datetime.fromisoformat(told["at"]).tzinfo == UTC
