"""Progress lines: what a person reads while a run, an optimisation or a study goes on."""

from __future__ import annotations

import io
import sys
from typing import Any

import pytest

from hil.cli import progress
from hil.cli.output import fold
from hil.cli.progress import ExcitationLine, ProgressLines
from hil.excitation.program import Advance
from tests.support.terminal_parts import terminal_on

# Progress lines: what a person reads while a run goes on


CLEAR = "\r\x1b[K"


class Terminal(io.StringIO):
    """Standard error that is a terminal."""

    def isatty(self) -> bool:
        return True

    @property
    def shown(self) -> list[str]:
        """What is on the screen in the end: a line that was cleared is gone."""
        return [line.rpartition(CLEAR)[2] for line in self.getvalue().split("\n")]


def step_event(step: int, **more: Any) -> dict[str, Any]:
    return {
        "kind": "progress",
        "step": step,
        "steps": 40,
        "doing": "dwell",
        "pose": 17,
        "trajectory": -1,
        "device_s": 2.0 * step,
        "wall_s": 2.0 * step,
        "duration_s": 80.0,
        **more,
    }


def step(index: int, **more: Any) -> dict[str, Any]:
    what = {"doing": "dwell", "pose": 17, "trajectory": -1, "load": 0}
    return {"kind": "step", "step": index, "steps": 40, **what, **more}


def state(state: str, reason: str = "") -> dict[str, Any]:
    return {"kind": "state", "state": state, "reason": reason}


def piped(capsys: pytest.CaptureFixture[str], *events: dict[str, Any]) -> list[str]:
    lines = ProgressLines()
    for event in events:
        lines.notify(event)
    return capsys.readouterr().err.splitlines()


def on_terminal(
    monkeypatch: pytest.MonkeyPatch, *events: dict[str, Any], columns: int = 80
) -> Terminal:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setattr("hil.cli.progress.TERMINAL_EVERY_S", 0.0)
    lines = ProgressLines()
    for event in events:
        lines.notify(event)
    return terminal


END = (step_event(39, device_s=100.0, wall_s=2.0), state("stopping"), state("done", "completed"))


def test_of_a_run_that_was_gone_on_with_it_is_told_of_what_the_share_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    terminal = on_terminal(monkeypatch, step_event(10, resumed=1))
    assert terminal.shown == [
        " 25 % of the remaining plan  step 11/40 dwell, pose 17  1 min 00 s left"
    ]


def test_the_line_says_how_far_where_and_how_long(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = on_terminal(monkeypatch, step_event(10))
    assert terminal.shown == [" 25 %  step 11/40 dwell, pose 17  1 min 00 s left"]


def test_a_completed_program_is_100_percent_however_long_the_dwells_took(
    capsys: pytest.CaptureFixture[str],
) -> None:
    *_, last = piped(capsys, *END)
    assert last == "100 %  40 steps in 2.0 s  1 min 40 s of motion, 50× real time"


@pytest.mark.parametrize("index", [38, 39])
def test_a_run_that_takes_longer_than_planned_is_not_done_before_its_end(
    capsys: pytest.CaptureFixture[str], index: int
) -> None:
    (line,) = piped(capsys, step_event(index, device_s=120.0, wall_s=120.0))
    assert line.startswith(" 99 %")


def test_a_run_that_is_stopped_in_its_last_step_is_not_100_percent(
    capsys: pytest.CaptureFixture[str],
) -> None:
    lines = piped(capsys, step_event(39), state("stopping", "stopped by SIGTERM"))
    assert lines[-1] == "stopping: stopped by SIGTERM"
    assert not [line for line in lines if line.startswith("100")]


def test_a_pipe_gets_a_line_now_and_then_and_the_last_one(
    capsys: pytest.CaptureFixture[str],
) -> None:
    events = [event for i in range(40) for event in (step(i), step_event(i))]
    lines = piped(capsys, *events, *END)
    assert [line[:4] for line in lines] == ["  0 ", "100 "]


def test_a_pause_and_its_reason_stay_on_the_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    reason = "interlock temperature: elbow_joint at 71.2 °C, limit 70 °C"
    terminal = on_terminal(
        monkeypatch,
        step_event(10),
        state("paused", reason),
        step_event(10, state="paused"),
        columns=60,
    )
    assert terminal.shown[:2] == [
        "paused: interlock temperature: elbow_joint at 71.2 °C, limit",
        "  70 °C",
    ]
    assert terminal.shown[2].startswith(" 25 %  paused: interlock temperature")


def test_going_on_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    lines = piped(
        capsys, state("running"), state("paused", "why"), state("running", "resumed by ann")
    )
    assert lines == ["paused: why", "running again: resumed by ann"]


def test_who_asks_for_a_pause_is_heard_before_the_checkpoint(
    capsys: pytest.CaptureFixture[str],
) -> None:
    asked = step_event(10, pausing="SIGINT: press Enter to resume, or Ctrl-C again to stop")
    lines = piped(capsys, step_event(9), asked, asked, state("paused", "SIGINT"), step_event(10))
    assert lines[1:] == [
        "pausing at the next checkpoint: SIGINT: press Enter to resume, or Ctrl-C again to stop",
        "paused: SIGINT",
    ]


def test_paused_time_is_no_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    held = step_event(10, device_s=50.0, wall_s=50.0, state="paused")
    going = step_event(11, device_s=54.0, wall_s=54.0, state="running")
    told = on_terminal(
        monkeypatch, step_event(10), state("paused", "why"), held, state("running"), going
    )
    assert told.shown[-1].startswith(" 30 %")  # 20 s before and 4 s after the pause, of 80 s
    assert "56.0 s left" in told.shown[-1]


def test_what_is_wrong_with_the_recording_comes_before_the_rest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wrong = {"gaps": 2, "missing": 5, "duplicates": 1, "overruns": 571, "behind_s": 0.8}
    (line,) = on_terminal(monkeypatch, step_event(10, **wrong), columns=120).shown
    said = " 25 %  2 gaps (5 samples missing)  1 duplicate  recorder 0.8 s behind  step 11/40"
    assert line.startswith(said)
    assert "571" not in line  # late samples are no loss: the end of the run counts them


def test_a_recorder_that_keeps_up_is_not_mentioned(monkeypatch: pytest.MonkeyPatch) -> None:
    (line,) = on_terminal(monkeypatch, step_event(10, gaps=0, behind_s=0.3)).shown
    assert "recorder" not in line
    assert "gap" not in line


@pytest.mark.parametrize("columns", [20, 40, 60, 120])
def test_the_moving_line_never_wraps(monkeypatch: pytest.MonkeyPatch, columns: int) -> None:
    events = [step_event(i, gaps=i, missing=i, behind_s=9.0) for i in range(10)]
    terminal = on_terminal(monkeypatch, *events, columns=columns)
    drawn = terminal.getvalue().split(CLEAR)
    assert "\n" not in terminal.getvalue()
    assert max(map(len, drawn)) < columns
    assert drawn[-1].endswith("…") == (columns < 120)


def test_a_path_is_never_cut_in_two() -> None:
    path = "/lab/runs/2026-11-21/ur5/0042-fourier-p3kg"
    assert path in fold(f"running fourier → {path} …", 30).split()


def test_the_line_is_out_of_the_way_before_a_question(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = {"kind": "prompt", "text": "Mount the 3 kg disc", "answered_by": ""}
    terminal = on_terminal(monkeypatch, step_event(10), asked, step_event(10), step_event(10))
    assert terminal.getvalue().endswith("left\n")  # and nothing is drawn over the answer
    answered = {**asked, "answered_by": "ann"}
    terminal = on_terminal(monkeypatch, asked, step_event(10), answered, step_event(11))
    assert terminal.shown[0] == "answered by ann: Mount the 3 kg disc"
    assert "step 12/40" in terminal.shown[1]


def test_a_pipe_is_told_what_is_asked(capsys: pytest.CaptureFixture[str]) -> None:
    asked = {"kind": "prompt", "text": "Mount the 3 kg disc", "answered_by": ""}
    assert piped(capsys, asked) == ["prompt: Mount the 3 kg disc"]


def test_a_no_is_told_with_its_name(capsys: pytest.CaptureFixture[str]) -> None:
    no = {"kind": "prompt", "text": "Mount the disc", "answered_by": "anna", "answer": "no"}
    assert piped(capsys, no) == ["anna answered no: Mount the disc"]


def test_a_pause_during_a_question_comes_after_the_answer(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = {"kind": "prompt", "text": "Mount it", "answered_by": ""}
    wished = step_event(10) | {"pausing": "asked by anna"}
    told = piped(capsys, asked, wished)
    assert told[1] == "pausing after the answer to this prompt: asked by anna"
    # On a terminal whoever asks says so, and asks again.
    assert "pausing" not in on_terminal(monkeypatch, asked, wished).getvalue()


@pytest.mark.parametrize("kind", ["stage", "state", "step", "progress", "prompt", "unheard of"])
def test_events_that_lack_everything_do_no_harm(
    capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    piped(capsys, {"kind": kind}, step_event(10))


def test_the_way_back_of_a_resumed_run_has_no_step_number(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (line,) = on_terminal(monkeypatch, step(-1, doing="move", pose=-1)).shown
    assert line == "  0 %  returning to the plan"


# How far an optimisation is: one line on a terminal, nothing but notes in a pipe


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


# Lines of a study in a pipe: news at once, progress now and then, nothing twice a minute


@pytest.fixture
def bar(monkeypatch):
    """A display without a terminal whose clock is at `bar.now`."""
    made = progress.StudyLine()
    made.now = 1000.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: made.now)
    return made


def test_a_line_that_says_the_same_is_seldom_repeated(bar, capsys) -> None:
    for second in range(240):
        bar.now = 1000.0 + second
        bar.show("a", "fits", 0, 6)
    assert capsys.readouterr().err.count("a: fits 0/6\n") == 2


def test_progress_is_told_every_ten_seconds_and_what_is_new_at_once(bar, capsys) -> None:
    for second in range(30):
        bar.now = 1000.0 + second
        bar.show("a", "fits", second, 60)
    bar.now += 1.0
    bar.show("a", "tables", 0, 0)
    assert capsys.readouterr().err.splitlines() == [
        "a: fits 0/60", "a: fits 10/60", "a: fits 20/60", "a: tables",
    ]  # fmt: skip
