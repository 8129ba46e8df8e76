"""The page about the Python API: its script runs, its signatures are those of the code."""

from __future__ import annotations

import dataclasses
import inspect
import os
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
import typer

import hil
from hil import api
from hil.cli.app import app
from hil.evaluation.fitting import FitReport, Fitted
from hil.workflow.running import RunReport
from tests.support.paths import DOCS, EXPERIMENTS

PAGE = (DOCS / "reference" / "api.md").read_text("utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
FUNCTIONS = [name for name in hil.__all__ if inspect.isfunction(getattr(api, name))]


REFERENCE = (DOCS / "reference" / "python.md").read_text("utf-8")
DIRECTIVES = re.findall(r"^::: (\S+)$", REFERENCE, re.MULTILINE)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_function_has_a_row_and_is_in_the_generated_reference(name: str) -> None:
    rows = re.findall(r"^\| `hil\.(\w+)\((.*?)\)`", PAGE, re.MULTILINE)
    shown = dict(rows)[name]
    known = inspect.signature(getattr(api, name)).parameters
    assert set(re.findall(r"(\w+)=", shown)) <= known.keys()
    function = getattr(hil, name)
    assert f"{function.__module__}.{function.__qualname__}" in DIRECTIVES


@pytest.mark.parametrize("directive", DIRECTIVES)
def test_what_the_reference_names_exists_and_is_described(directive: str) -> None:
    module, _, name = directive.rpartition(".")
    assert inspect.getdoc(getattr(import_module(module), name))


@pytest.mark.parametrize("name", hil.__all__)
def test_a_public_name_is_the_function_of_the_package_that_implements_it(name: str) -> None:
    public = getattr(hil, name)
    package = ".".join(public.__module__.split(".")[:2])
    assert package != "hil.api"
    assert getattr(import_module(package), name) is public
    assert public.__name__ == name


@pytest.mark.parametrize("report", [RunReport, FitReport], ids=lambda kind: kind.__name__)
def test_every_attribute_of_a_report_has_a_row(report: type) -> None:
    section = PAGE.split(f"\n### `{report.__name__}`")[1].split("\n#")[0]
    rows = re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)
    assert rows == [field.name for field in dataclasses.fields(report)]


def test_everything_about_a_fitted_model_is_mentioned() -> None:
    for field in dataclasses.fields(Fitted):
        assert f"`fitted.{field.name}`" in PAGE


BY_FUNCTION = {
    "validate": "load", "plan": "plan", "run": "run", "resume": "resume", "runs": "find_runs",
    "fit": "fit", "evaluate": "evaluate", "payload": "estimate_payload",
    "study": "study", "figures": "figures", "rest-pose": "rest_poses", "export": "export_model",
    "simulate": "simulate", "import": "import_recording", "export-data": "export_data",
    "models": "registry", "reidentify": "reidentify",
}  # fmt: skip
"""What does in Python what a verb does; `models compare` has none."""


def test_a_verb_without_a_function_is_named_on_top() -> None:
    top = PAGE.split("Verbs without a function:")[1].split(";")[0]
    verbs = set(typer.main.get_command(app).commands)  # type: ignore[attr-defined]
    told = set(re.findall(r"`([a-z -]+)`", top))
    assert told == (verbs - BY_FUNCTION.keys()) | {"models compare"}
    assert set(BY_FUNCTION.values()) <= set(hil.__all__)


@pytest.mark.thorough
def test_the_script_runs_as_it_stands_there(tmp_path: Path) -> None:
    (tmp_path / "experiments").symlink_to(EXPERIMENTS)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", BLOCKS[0]],
        cwd=tmp_path,
        env={**os.environ, "HIL_STATION": ""},
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr
    told = done.stdout.splitlines()
    assert told[1].startswith("completed passed")
    assert "24 dwells, (240, 6) [A]" in told
    assert len(list((tmp_path / "models").glob("static-wls-*/model.json"))) == 1
