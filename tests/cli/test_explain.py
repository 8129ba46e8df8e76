"""`hil explain`: what a key means, in the words of the reference page, and what exit codes mean."""

from __future__ import annotations

import json
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner, Result

from hil.cli.app import EXIT_CODES, app
from hil.cli.explain import KINDS
from hil.core import errors
from hil.core.errors import HilError, SpecError
from hil.spec.documentation import (
    MODELS,
    KeyInfo,
    example_of,
    explain_key,
    keys_below,
    reference,
)


def invoke(*words: str) -> Result:
    return CliRunner().invoke(app, ["explain", *words])


def told(key: str) -> list[dict[str, Any]]:
    keys: list[dict[str, Any]] = json.loads(invoke(key, "--json").stdout)["keys"]
    return keys


def test_a_key_is_told_with_all_there_is_to_know() -> None:
    (one,) = told("excitation.dwell_s")
    assert one == {
        "file": "experiment",
        "path": "excitation.dwell_s",
        "kind": "dwell",
        "unit": "s",
        "allowed": "number ≥ 0.01, ≤ 600",
        "default": "0.095",
        "meaning": "Minimum time at standstill in each pose.",
        "keys_below": [],
        "example": "dwell_s: 0.095",
        "documented": "docs/reference/spec.md, Experiment, `excitation` with `kind: dwell`",
    }
    assert "  unit     s\n" in invoke("excitation.dwell_s").stdout


@pytest.mark.parametrize(
    ("key", "file", "example"),
    [
        ("accept", "experiment", "accept: {rmse: {max: 0.35, unit: A, per: mean}}"),
        ("validate.hold_out", "experiment", "hold_out: {trajectories: 3}"),
        ("robots.left.surroundings.table_z_m", "station", "table_z_m: 0.0"),
        ("probe.every", "schedule", "every: 2min"),
        ("fit.0.estimator", "experiment", "estimator: static-wls"),
    ],
)
def test_keys_of_every_file_have_a_line_to_copy(key: str, file: str, example: str) -> None:
    (one,) = told(key)
    assert (one["file"], one["example"]) == (file, example)


@pytest.mark.parametrize("file", MODELS)
def test_examples_are_yaml_of_their_key(file: str) -> None:
    for info in keys_below(MODELS[file]):
        line = example_of(KeyInfo(**{**vars_of(info), "file": file}))
        assert not line or list(yaml.safe_load(line)) == [info.path.rpartition(".")[2]], line


def test_what_several_kinds_share_is_told_once() -> None:
    assert [(one["kind"], one["meaning"][:5]) for one in told("interlocks.enabled")] == [
        ("", "`fals"),
        ("stale", "Alway"),
    ]


@pytest.mark.parametrize("key", ["a.b.c", "nonsense", "robots.x.y.z"])
def test_a_key_that_is_none_is_told_in_a_few_words(key: str) -> None:
    error = invoke(key).exception
    assert isinstance(error, SpecError)
    assert len(error.hint) < 200, error.hint
    assert "docs/reference/spec.md" in error.hint or "did you mean" in error.hint


@pytest.mark.parametrize("key", ["", ".", " ", "0", "a..b", "..."])
def test_a_key_with_an_empty_step_is_refused(key: str) -> None:
    error = invoke(key).exception
    assert isinstance(error, SpecError)
    assert error.message == f"{key!r} is not a key"
    assert error.hint == "for example: hil explain excitation.dwell_s"


def test_sections_are_those_of_the_page() -> None:
    page = reference()
    for key in ("excitation.seed", "robots.a.driver", "hil_series", "interlocks.limit_rad"):
        title = told(key)[0]["documented"].rpartition(", ")[2]
        assert f"\n### {title}\n" in page


def test_a_slip_is_guessed_at() -> None:
    error = invoke("excitation.dwel_s").exception
    assert isinstance(error, SpecError)
    assert error.hint == "did you mean 'excitation.dwell_s'?"


@pytest.mark.thorough
def test_every_exit_code_is_explained() -> None:
    raised = [error for error in vars(errors).values() if isinstance(error, type)]
    for error in raised:
        if issubclass(error, HilError) and error is not HilError:
            document = json.loads(invoke("exit", str(error.exit_code), "--json").stdout)
            assert error.__name__ in [one["kind"] for one in document["errors"]]
    assert "InterlockTripped" in invoke("exit", "5").stdout
    assert all(f"{code} " in invoke("exit").stdout for code in ("0", "1", "11", "130"))
    assert "11 registry" in EXIT_CODES


def test_a_code_that_is_none_is_refused() -> None:
    error = invoke("exit", "77").exception
    assert isinstance(error, SpecError)
    assert "exit codes are 0, 1, 2, 3" in error.hint


def vars_of(info: KeyInfo) -> dict[str, str]:
    return {name: getattr(info, name) for name in KeyInfo.__dataclass_fields__}


def test_the_longer_path_is_found_by_its_end() -> None:
    assert explain_key("hold_out.seed") == explain_key("validate.hold_out.seed")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("waypoint", "waypoints"),
        ("dwel_s", "dwell_s"),
        ("hold_ot", "hold_out"),
    ],
)
def test_a_slip_in_the_end_of_a_path_is_guessed(typed: str, meant: str) -> None:
    error = invoke(typed).exception
    assert isinstance(error, SpecError)
    assert error.hint == f"did you mean {meant!r}?"
    assert told(meant)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_file_has_a_schema(kind: str) -> None:
    assert json.loads(CliRunner().invoke(app, ["schema", kind]).stdout)["title"] == f"hil {kind}"


def test_every_file_that_hil_explains_has_a_schema() -> None:
    assert set(MODELS) < set(KINDS)


def test_a_kind_without_a_schema_is_refused_with_a_guess() -> None:
    error = CliRunner().invoke(app, ["schema", "fleat"]).exception
    assert isinstance(error, SpecError)
    assert error.hint == "did you mean 'fleet'?"
