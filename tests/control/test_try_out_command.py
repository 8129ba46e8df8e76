"""`hil try-out` on the command line: what it refuses, what it prints, how it ends."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from hil import api
from hil.cli.app import app
from hil.control.try_out_settings import FRICTION_SHARE
from hil.core.errors import HilError, RecordingError, Rejected, SpecError
from tests.support.trial_parts import ELSEWHERE, model_folder, short_trial


@pytest.fixture
def place():
    """Where the station is."""
    return short_trial()[1]


@pytest.fixture
def trial():
    """A trial whose model meets all it is held to."""
    made, _ = short_trial()
    helped = replace(made.led[-1], effort=0.4 * made.led[0].effort)
    return replace(made, led=(*made.led[:-1], helped), notes=())


@pytest.fixture
def asked(trial, monkeypatch):
    """The command line, with a trial that is over."""
    ended = [trial]
    monkeypatch.setattr("hil.api.try_out", lambda *given, **options: ended[0])
    given = ["try-out", str(model_folder()), "-o", "out"]
    return ended, lambda *more: CliRunner().invoke(app, [*given, *more])


def test_the_page_comes_first_then_a_few_lines(asked) -> None:
    done = asked[1]()
    lines = done.stdout.splitlines()
    assert done.exit_code == 0
    assert lines[0] == "report: out/report.html"
    assert len(lines) < 10
    assert any("at most half in every joint" in line for line in lines)


def test_lines_are_folded_to_the_terminal(asked, monkeypatch) -> None:
    monkeypatch.setattr("hil.cli.output.width_of", lambda stream: 60)
    lines = asked[1]().stdout.splitlines()
    assert max(map(len, lines)) <= 60


def test_json_says_that_all_is_well(asked) -> None:
    document = json.loads(asked[1]("--json").stdout)
    assert document["report"] == "out/report.html"
    assert document["rate_hz"] == 1000.0
    assert document["hand"]["friction_share"] == FRICTION_SHARE
    assert document["ok"] is True
    assert [criterion["met"] for criterion in document["criteria"]] == [True] * 4


def test_an_arm_that_does_not_rest_ends_with_the_code_of_a_bad_result(asked) -> None:
    ended, ask = asked
    restless = replace(ended[0].led[-1], rest_s=float("inf"))
    ended[0] = replace(ended[0], led=(*ended[0].led[:-1], restless))
    done = ask("--json")
    assert isinstance(done.exception, Rejected)
    assert done.exception.exit_code == 10
    assert "take less of the friction" in done.exception.hint
    assert json.loads(done.stdout)["ok"] is False


def test_a_hand_that_is_not_relieved_enough_is_a_bad_result(asked) -> None:
    ended, ask = asked
    poor = replace(ended[0].led[-1], effort=0.6 * ended[0].led[0].effort)
    ended[0] = replace(ended[0], led=(*ended[0].led[:-1], poor))
    done = ask()
    assert isinstance(done.exception, Rejected)
    assert "60 60 60 60 60 60 % (mean 60 %): at most half in no joint" in done.stdout


@pytest.mark.parametrize(
    "more",
    [
        ["--robot", "arm", "--friction-share", "1.0"],
        ["--robot", "arm", "--payload", "heavy"],
        ["--robot", "arm", "--payload", "50"],
        ["--robot", "nobody"],
        ["--robot", "real"],
        ["--robot", "arm", "--seed", "99999999999999"],
    ],
)
def test_nothing_is_made_before_all_is_checked(place, tmp_path, more) -> None:
    given = ["try-out", str(model_folder()), "-o", str(tmp_path / "new")]
    done = CliRunner().invoke(app, [*given, "--station", str(place / "station.yaml"), *more])
    assert isinstance(done.exception, HilError | SystemExit)
    assert done.exit_code
    assert not (tmp_path / "new").exists()


def test_a_seed_beyond_those_there_are_is_refused() -> None:
    with pytest.raises(SpecError, match="the seed is 99999999999999, but must be 0 to"):
        api.try_out(model_folder(), "never-made", seed=99999999999999)


def test_a_folder_that_exists_is_left_alone(tmp_path) -> None:
    with pytest.raises(RecordingError, match="exists already"):
        api.try_out(model_folder(), tmp_path)
    assert not list(tmp_path.iterdir())


def test_another_individual_is_warned_of_before_anything_else(asked) -> None:
    ended, ask = asked
    notes = short_trial()[0].notes
    ended[0] = replace(ended[0], notes=notes)
    assert ask().stdout.startswith(
        f"warning: ANOTHER INDIVIDUAL: the model was fitted on {ELSEWHERE}, and tried on arm-full-5"
    )
    assert notes[-1].startswith("led by less than 20°")


@pytest.mark.thorough
def test_another_individual_that_nobody_asked_for_is_refused(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HIL_STATION", raising=False)
    with pytest.raises(SpecError, match="no station was named") as refused:
        api.try_out(model_folder(), "new")
    assert "--station FILE" in refused.value.hint
    assert not (tmp_path / "new").exists()
