"""Former names of verbs and options, and `hil` without a verb."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from hil.cli.app import PANELS, RENAMED, app
from tests.support.paths import EXPERIMENTS


def invoke(*words: str) -> Result:
    return CliRunner().invoke(app, list(words), env={"COLUMNS": "100"})


@pytest.mark.parametrize(("before", "now"), [("excite", "optimise"), ("gains", "drive-gains")])
def test_a_former_verb_is_answered_with_its_present_name(before: str, now: str) -> None:
    done = invoke(before, "spec.yaml")
    assert done.exit_code == 2
    assert f"`hil {before}` is now `hil {now}`" in done.output


@pytest.mark.parametrize(
    ("words", "now"),
    [
        (("run", "spec.yaml", "--first", "3"), "--limit"),
        (("plan", "spec.yaml", "--speed", "10%"), "--speed-scale"),
        (("resume", "last", "--elsewhere"), "--no-console"),
        (("rest-pose", "model", "--unchecked"), "--no-collision-check"),
        (("mock", "embedded", "--truth", "truth.json"), "--ground-truth"),
    ],
)
def test_a_former_option_is_answered_with_its_present_name(
    words: tuple[str, ...], now: str
) -> None:
    done = invoke(*words)
    assert done.exit_code == 2
    assert now in done.output


def test_every_verb_is_in_one_panel_and_no_former_name_is() -> None:
    listed = [verb for verbs in PANELS.values() for verb in verbs]
    assert len(listed) == len(set(listed))
    assert set(RENAMED).isdisjoint(listed)
    page = invoke("--help").output
    assert all(panel in page for panel in PANELS)


def test_hil_alone_suggests_templates_in_an_empty_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = invoke()
    assert done.exit_code == 0
    assert "hil new dwell" in done.output


def test_hil_alone_suggests_specs_and_the_newest_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text((EXPERIMENTS / "ci_dwell_12.yaml").read_text("utf-8"))
    assert "hil run mine.yaml" in invoke().output
    assert invoke("run", "mine.yaml", "--limit", "1").exit_code == 0
    assert "hil show runs/" in invoke().output
