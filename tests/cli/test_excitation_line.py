"""How far an optimisation is: one line on a terminal, nothing but notes in a pipe."""

from __future__ import annotations

import pytest

from hil.cli.progress import ExcitationLine, ProgressLines
from hil.excitation.program import Advance
from tests.support.terminal_parts import terminal_on

BUSY = Advance(3, 12, 2, 3, 17.25, 125.0)


def test_the_line_says_what_matters_first_and_never_wraps(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = terminal_on(monkeypatch, 40)
    with ExcitationLine() as line:
        line(BUSY)
        (shown,) = [part for part in terminal.getvalue().split("\r\x1b[K") if part]
        assert shown.startswith("optimising trajectory 3/12  2 min 05 s")
        assert len(shown) < 40
    assert terminal.getvalue().endswith("\r\x1b[K")


def test_a_pipe_gets_notes_only(capsys: pytest.CaptureFixture[str]) -> None:
    with ExcitationLine() as line:
        line(BUSY)
        line(Advance(note="the cache is damaged"))
    told = capsys.readouterr()
    assert (told.out, told.err) == ("", "note: the cache is damaged\n")


def test_a_run_shows_it_until_the_next_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = terminal_on(monkeypatch, 40)
    lines = ProgressLines()
    lines.notify(BUSY.to_event())
    lines.notify({"kind": "stage", "stage": "running"})
    assert terminal.getvalue().endswith("\r\x1b[Krunning …\n")


def test_an_event_says_all_that_was_told() -> None:
    assert Advance.from_event(BUSY.to_event()) == BUSY
