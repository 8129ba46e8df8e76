"""Files that values from a browser may name: those of the offered folder, and nothing is quoted."""

from __future__ import annotations

import re
from html import unescape
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from hil.core.errors import SpecError
from hil.dashboard.start_page import FILE_KEYS
from hil.excitation.dwell import MOST_QUOTED, read_waypoints
from hil.spec.experiment import ExperimentSpec
from hil.spec.model_tree import tree
from tests.support.started_parts import written
from tests.support.web_parts import dashboard

SECRET = "root:x:0:0:of:one:line,only"


@pytest.fixture
def desk(tmp_path: Path) -> TestClient:
    specs = tmp_path / "specs"
    (specs / "deep").mkdir(parents=True)
    written(specs)
    (tmp_path / "secret.txt").write_text(SECRET + "\n")
    (specs / "link.csv").symlink_to(tmp_path / "secret.txt")
    (specs / "loop.csv").symlink_to(specs / "loop.csv")
    (specs / "mine.csv").write_text("of, mine\n")
    (specs / "deep" / "mine.csv").write_text("of, mine\n")
    return dashboard(tmp_path)


def asked(desk: TestClient, do: str, overrides: str) -> tuple[int, str]:
    settings: Any = desk.app.state.settings  # type: ignore[attr-defined]
    form = {"csrf": settings.csrf, "spec": "asks.yaml", "do": do, "overrides": overrides}
    answer = desk.post("/start", data=form, follow_redirects=False)
    assert not settings.runs.exists()
    return answer.status_code, unescape(re.sub("<[^>]+>", "", answer.text))


@pytest.mark.parametrize(
    "overrides",
    [
        "excitation.file=/etc/passwd",
        "excitation.file=/no/such/file",
        "excitation.file=/proc/self/environ",
        "excitation.file=../secret.txt",
        "excitation.file=deep/../../secret.txt",
        "excitation.file=link.csv",
        "excitation.file=loop.csv",
        'excitation.file="\\\\x2fetc/passwd"',
        "excitation={kind: dwell, waypoints: 2, file: ../secret.txt}",
        "excitation={kind: dwell, waypoints: 2, file: &a ../secret.txt}",
        "fit=[{estimator: static-wls, prior: /etc/passwd}]",
        "fit=[{estimator: static-wls, prior: [a, {b: ../secret.txt}]}]",
        "interlocks=[{kind: of-a-plug-in, limits: ../secret.txt}]",
    ],
)
@pytest.mark.parametrize("do", ["check", "start"])
def test_a_file_outside_is_neither_read_nor_told_of(
    desk: TestClient, overrides: str, do: str
) -> None:
    status, text = asked(desk, do, overrides.replace("\\\\", "\\"))
    assert status == 422
    assert "is not in the folder that is offered here" in text
    assert SECRET[:6] not in text


@pytest.mark.parametrize("file", ["mine.csv", "deep/mine.csv", "./deep/../mine.csv"])
def test_a_file_of_the_offered_folder_is_read(desk: TestClient, file: str) -> None:
    status, text = asked(desk, "check", f"excitation.file={file}")
    assert status == 422
    assert "neither a pose nor the joints' names: of, mine" in text


@pytest.mark.parametrize("do", ["check", "start"])
def test_a_file_that_no_program_has_is_not_read(desk: TestClient, do: str) -> None:
    with (desk.app.state.settings.specs / "long.csv").open("wb") as file:  # type: ignore[attr-defined]
        file.truncate(10**10)
    status, text = asked(desk, do, "excitation.file=long.csv")
    assert status == 422
    assert "more than 20 MB" in text


def test_prose_may_look_like_a_path(desk: TestClient) -> None:
    status, text = asked(desk, "check", "description=see /etc\nexcitation.waypoints=none")
    assert status == 422
    assert "is not in the folder" not in text


def test_every_key_that_is_a_file_is_known() -> None:
    """Of the keys that are told to be paths or files; a new one belongs into `FILE_KEYS`."""
    found = {
        name
        for _, model in tree(ExperimentSpec)
        for name, field in model.model_fields.items()
        if str in getattr(field.annotation, "__args__", (field.annotation,))
        and re.search(r"\b(path|file|folder)\b", field.description or "", re.IGNORECASE)
    }
    assert found - {"file_unit"} == set(FILE_KEYS)


@pytest.mark.parametrize(
    "text",
    ["s" * 500, "s" * 200_000, "0,0\n0," + "s" * 500, "0,0\n0," + "9" * 500, "0,0\n" + "s" * 500],
)
def test_of_a_line_that_is_no_pose_little_is_quoted(tmp_path: Path, text: str) -> None:
    path = tmp_path / "0.csv"
    path.write_text(text)
    try:
        told = "\n".join(read_waypoints(path, ["a", "b"], "deg").problems)
    except SpecError as error:
        told = error.message
    assert told.startswith(f"{path}:")
    assert max(map(len, re.findall("sss+|999+", told)), default=0) <= MOST_QUOTED
