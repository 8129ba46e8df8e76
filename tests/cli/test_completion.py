"""Completion as shells really do it: the script that `hil` gives out, run by the shell itself."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import typer

from hil.cli import completion
from hil.cli.app import app
from hil.cli.completion import BY_COMMAND, BY_NAME, Words, commands

BIN = Path(sys.executable).parent

BASH = """
eval "$(_HIL_COMPLETE=source_bash hil)"
COMP_WORDS=("$@")
COMP_CWORD=$(($# - 1))
_hil_completion hil
printf '%s\\n' "${COMPREPLY[@]}"
"""

ZSH = """
compdef() { : }
_arguments() { print -r -- "$*" }
_files() { print files }
eval "$(_HIL_COMPLETE=source_zsh hil)"
words=("$@"); CURRENT=$#
_hil_completion hil
"""

FISH = """
_HIL_COMPLETE=source_fish hil | source
complete -C "$argv"
"""

STATION = "hil_station: 1\nname: bench\nrobots:\n  left: {driver: mock}\n  right: {driver: mock}\n"


@pytest.fixture
def bench(tmp_path: Path) -> Path:
    """A folder with two runs, a spec, a station, another YAML file and a registered model."""
    for name in ("0001-first", "0012-second"):
        (tmp_path / "runs" / "2026-11-20" / "ur5" / name / "recording").mkdir(parents=True)
    (tmp_path / "registry" / "welding" / "v1").mkdir(parents=True)
    (tmp_path / "mine.yaml").write_text("# a spec\nhil: 1\nname: mine\n", "utf-8")
    (tmp_path / "station.yaml").write_text(STATION, "utf-8")
    (tmp_path / "other.yaml").write_text("a: 1\n", "utf-8")
    return tmp_path


def complete(shell: str, folder: Path, *words: str) -> list[str]:
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell} here")
    said = {
        "bash": ["bash", "--norc", "-c", BASH, "bash", *words],
        "zsh": ["zsh", "-f", "-c", ZSH, "zsh", *words],
        "fish": ["fish", "--no-config", "-c", FISH, " ".join(words)],
    }[shell]
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("HIL_", "_HIL"))}
    environment |= {"PATH": f"{BIN}{os.pathsep}{os.environ['PATH']}", "HOME": str(folder)}
    done = subprocess.run(said, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (("hil", "sho"), ["show"]),
        (("hil", "show", ""), ["0001-first", "0012-second"]),
        (("hil", "show", "1"), ["1", "12"]),
        (("hil", "show", "runs/2026-11-20/ur5/0012"), ["runs/2026-11-20/ur5/0012-second"]),
        (("hil", "run", ""), ["mine.yaml"]),
        (("hil", "run", "mine.yaml", "--station", ""), ["station.yaml"]),
        (("hil", "record", "--robot", ""), ["left", "right"]),
        (("hil", "fit", "12", "-e", "static-w"), ["static-wls"]),
        (("hil", "models", "show", ""), ["welding"]),
        (("hil", "models", "show", "welding", ""), ["champion", "challenger", "v1"]),
        (("hil", "export", "12", "--to", "onn"), ["onnx", "onnx-mlp"]),
        (("hil", "answer", "12", ""), ["yes", "no"]),
        (("hil", "show", "no-such"), []),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_bash_offers_what_there_is(bench: Path, words: tuple[str, ...], offered: list[str]) -> None:
    assert complete("bash", bench, *words) == offered


def test_another_folder_of_runs_is_looked_into_when_it_stands_before(bench: Path) -> None:
    (bench / "old" / "2025-01-01" / "ur5" / "0003-old" / "recording").mkdir(parents=True)
    assert complete("bash", bench, "hil", "show", "--runs", "old", "") == ["0003-old"]


@pytest.mark.thorough
def test_only_runs_are_offered_where_runs_are_asked(bench: Path) -> None:
    day = bench / "runs" / "2026-11-21"
    for other in ("simulations/simulation-weekly", "series/two-loads", "ur5/compared"):
        (day / other).mkdir(parents=True)
    (day / "series" / "two-loads" / "series.json").touch()
    (bench / "runs" / "compared" / "runs" / "ur5-001").mkdir(parents=True)
    assert complete("bash", bench, "hil", "show", "") == ["0001-first", "0012-second"]
    assert complete("bash", bench, "hil", "show", "runs/2026-11-21") == []
    assert complete("bash", bench, "hil", "report", "") == [
        "0001-first",
        "0012-second",
        "two-loads",
    ]


def test_zsh_and_fish_offer_the_same(bench: Path) -> None:
    told = " ".join(complete("zsh", bench, "hil", "show", ""))
    assert "0001-first" in told
    assert "0012-second" in told
    assert complete("fish", bench, "hil", "show", "00") == ["0001-first", "0012-second"]


def test_nothing_is_offered_and_nothing_raised_in_a_folder_of_rubbish(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").write_text("no folder")
    (tmp_path / "station.yaml").write_bytes(b"\xff: [\n")
    (tmp_path / "folder.yaml").mkdir()

    def offered(words: Words, **before: str) -> list[str]:
        return completion._completion_of(words)(SimpleNamespace(params=before), "")

    assert offered(BY_NAME["run"]) == []
    assert offered(BY_NAME["robot"]) == []
    assert offered(BY_NAME["spec"]) == []
    assert offered(BY_COMMAND["models show", "name"]) == []
    assert "ur5" in offered(BY_NAME["robot"], station="none.yaml")


def test_every_completion_is_of_a_parameter_that_there_is() -> None:
    parameters = {
        (verb, name) for verb, callback in commands(app) for name in callback.__annotations__
    }
    assert set(BY_COMMAND) <= parameters
    assert set(BY_NAME) <= {name for _, name in parameters}
    assert isinstance(app, typer.Typer)


HEAVY = """
import os, sys
os.environ |= {"_HIL_COMPLETE": "complete_bash", "COMP_WORDS": "hil TYPED", "COMP_CWORD": "2"}
from hil.cli.app import main
try:
    main()
except SystemExit:
    pass
print(*sys.modules, sep="\\n", file=sys.stderr)
"""


@pytest.mark.thorough
@pytest.mark.parametrize("words", ["show 0", "run mi", "bench st"])
def test_completion_loads_nothing_heavy(bench: Path, words: str) -> None:
    code = HEAVY.replace("TYPED", words)
    done = subprocess.run([sys.executable, "-c", code], cwd=bench, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()
    loaded = {name.partition(".")[0] for name in done.stderr.split()}
    assert not loaded & {"numpy", "scipy", "mcap", "sklearn", "pinocchio", "mujoco", "torch"}
