"""Lines of a study in a pipe: news at once, progress now and then, nothing twice a minute."""

import pytest

from hil.cli import progress


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
