"""Every command keeps the same manners: one JSON document with `--json`, on errors too."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from hil.cli import app as command_line
from hil.cli.app import app

WITHOUT_JSON = {
    "schema": "prints nothing but a JSON document",
    "serve": "prints its address and then serves",
    "schedule run": "goes on until it is ended; `schedule show` has what was done",
    "schedule hold": "`schedule show` has it",
    "schedule release": "`schedule show` has it",
}
"""Commands without `--json`, and why."""

STARTS_SOMETHING = {"bench", "mock"}
"""Not called with whatever word: `list` is asked for."""

OPTIONS = {"estimator": "rigid-wls", "map_": "map.yaml", "out": "out", "reason": "because"}
"""What required options are given, else `nothing`."""

OURS = ("Error", "Timeout")
CODES = set(range(12)) - {1}


def verbs() -> Iterator[tuple[str, Any]]:
    def walk(command: Any, words: list[str]) -> Iterator[tuple[str, Any]]:
        for name, one in getattr(command, "commands", {}).items():
            yield from walk(one, [*words, name])
        if not hasattr(command, "commands"):
            yield " ".join(words), command

    yield from walk(typer.main.get_command(app), [])


VERBS = dict(verbs())


def has_json(command: Any) -> bool:
    return any("--json" in getattr(p, "opts", ()) for p in command.params)


def call(
    monkeypatch: pytest.MonkeyPatch, *words: str, columns: int | None = None
) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of `hil WORDS`, as the script ends it."""
    out, err = io.StringIO(), io.StringIO()
    if columns is not None:
        monkeypatch.setattr(out, "isatty", lambda: True, raising=False)
        monkeypatch.setenv("COLUMNS", str(columns))
    with monkeypatch.context() as patch:
        patch.setattr(sys, "argv", ["hil", *words])
        patch.setattr(sys, "stdout", out)
        patch.setattr(sys, "stderr", err)
        try:
            command_line.main()
            code: Any = 0
        except SystemExit as ending:
            code = ending.code or 0
    return code, out.getvalue(), err.getvalue()


def words_for(verb: str) -> list[str]:
    """The command with a word at every required place, none of which leads anywhere."""
    if verb in STARTS_SOMETHING:
        return [*verb.split(), "list"]
    words = verb.split()
    for parameter in VERBS[verb].params:
        if parameter.required:
            word = OPTIONS.get(parameter.name, "nothing")
            is_argument = parameter.param_type_name == "argument"
            words += [word] if is_argument else [parameter.opts[0], word]
    return words


@pytest.fixture
def empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, with nothing named by the environment."""
    for name in ("HIL_RUNS", "HIL_REGISTRY", "HIL_STATION"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HIL_LEASES", str(tmp_path / "leases"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_file_with_verbs_is_listed() -> None:
    folder = Path(command_line.__file__).parent
    files = {
        file.stem for file in folder.glob("*.py") if "\napp = typer.Typer(" in file.read_text()
    }
    assert files - {"app"} == set(command_line.FILES)


def test_commands_without_json_are_known_and_why() -> None:
    assert {verb for verb, one in VERBS.items() if not has_json(one)} == set(WITHOUT_JSON)


@pytest.mark.thorough
@pytest.mark.parametrize("verb", sorted(set(VERBS) - set(WITHOUT_JSON) - {"doctor"}))
def test_one_document_is_printed_when_nothing_is_there(
    verb: str, empty: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, out, err = call(monkeypatch, *words_for(verb), "--json")
    document = json.loads(out)
    assert code in CODES, err
    if code:
        assert set(document["error"]) == {"kind", "message", "hint", "exit_code"}
        assert document["error"]["exit_code"] == code
        if document["error"]["kind"].endswith(OURS):  # typer draws a box around its own
            assert document["error"]["message"].partition("\n")[0] in err
        assert document["error"]["hint"]
    else:
        assert "error" not in document


@pytest.mark.thorough
@pytest.mark.parametrize("verb", sorted(set(VERBS) - set(WITHOUT_JSON)))
def test_a_mistake_in_the_command_line_is_one_document(
    verb: str, empty: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if verb == "mock":
        pytest.skip("hands what it does not know to the mock")
    code, out, err = call(monkeypatch, *verb.split(), "--no-such-option", "--json")
    told = json.loads(out)["error"]
    assert code == told["exit_code"] == 2
    assert "--no-such-option" in told["message"]
    assert "--no-such-option" in err


LISTS = ("runs", "models list", "robots", "bench list", "mock list", "plugins")


@pytest.mark.thorough
@pytest.mark.parametrize("verb", LISTS)
@pytest.mark.parametrize("columns", [40, 60])
def test_lists_fit_a_narrow_terminal(
    verb: str, columns: int, empty: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, out, _ = call(monkeypatch, *verb.split(), columns=columns)
    assert code == 0
    unbroken = [  # a word longer than the terminal, such as a path, stays whole
        line for line in out.splitlines() if len(line) > columns and " " in line.strip()
    ]
    assert unbroken == []


@pytest.mark.thorough
@pytest.mark.parametrize("verb", LISTS)
def test_nothing_is_broken_in_a_pipe(
    verb: str, empty: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    code, out, _ = call(monkeypatch, *verb.split())
    assert code == 0
    if verb in ("bench list", "plugins", "mock list"):
        assert max(map(len, out.splitlines())) > 40


@pytest.mark.parametrize("verb", ["runs", "models list"])
def test_where_nothing_is_the_next_command_is_said(
    verb: str, empty: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, out, _ = call(monkeypatch, *verb.split())
    assert code == 0
    assert ": hil " in out


def test_an_argument_that_may_be_left_out_says_what_then() -> None:
    silent = [
        f"{verb} {parameter.name}"
        for verb, command in VERBS.items()
        for parameter in command.params
        if parameter.param_type_name == "argument" and not parameter.required
        if not parameter.help
        or not ("by default" in parameter.help or (parameter.show_default and parameter.default))
    ]
    assert silent == []
