"""The page about studies names every parameter with its default, every method, table and figure."""

from __future__ import annotations

import inspect
import re

import pytest

from hil.core import plugins
from hil.core.yaml import scalar
from hil.studies.base import GROUP
from hil.studies.dynamic_methods import METHOD_KEYS as DYNAMIC_KEYS
from hil.studies.dynamic_methods import METHODS as DYNAMIC_METHODS
from hil.studies.inverse_methods import DEFAULT_KEYS, ROW_KEYS, ROWS
from hil.studies.separation_honest import METHOD_KEYS, known_methods
from hil.studies.separation_tables import TABLE_3
from tests.support.paths import DOCS

PAGE = (DOCS / "reference" / "studies.md").read_text("utf-8")
OURS = [name for name in plugins.names(GROUP) if plugins.load(GROUP, name).__module__[:4] == "hil."]
IN_WORDS = {
    "the eight of Table 3": tuple(TABLE_3),
    "all": METHOD_KEYS,
    "all methods": DYNAMIC_KEYS,
    "all rows but `proposed-literal`": DEFAULT_KEYS,
    "none": None,
}


def rows_of(title: str) -> list[tuple[str, str]]:
    section = re.split(r"\n#", PAGE.split(f"\n{title}\n")[1])[0]
    return re.findall(r"^\| (`[^|]+`) \| (.+?) \|", section, re.MULTILINE)


def test_our_studies_are_registered() -> None:
    assert "static-separation" in OURS


@pytest.mark.parametrize("name", OURS)
def test_every_parameter_of_a_study_has_a_row_with_its_default(name: str) -> None:
    parameters = inspect.signature(plugins.load(GROUP, name)).parameters
    shown = {key.strip("`"): text for key, text in rows_of(f"## `{name}`")}
    assert list(shown) == list(parameters)
    for key, parameter in parameters.items():
        text, default = shown[key], parameter.default
        expected = list(default) if isinstance(default, tuple) else default
        told = IN_WORDS[text] if text in IN_WORDS else scalar(text.strip("`"))
        assert (list(told) if isinstance(told, tuple) else told) == expected, key


def test_every_method_has_a_row_with_its_estimator() -> None:
    shown = dict(rows_of("### Methods"))
    assert tuple(key.strip("`") for key in shown) == METHOD_KEYS
    known = known_methods(alpha=0.001, weights="paper", layout=(4, 1), epochs=1, seed=0)
    for key, text in shown.items():
        assert f"`{known[key.strip('`')].estimator}`" in text or "the same" in text


def test_every_method_of_dynamics_has_a_row_with_its_estimator() -> None:
    shown = dict(rows_of("### Methods of dynamics"))
    assert tuple(key.strip("`") for key in shown) == DYNAMIC_KEYS
    for key, text in shown.items():
        assert f"`{DYNAMIC_METHODS[key.strip('`')].estimator}`" in text


def test_every_row_of_table_ii_is_there_with_its_estimator() -> None:
    shown = dict(rows_of("### Rows of Table II"))
    assert tuple(key.strip("`") for key in shown) == ROW_KEYS
    for key, text in shown.items():
        assert f"`{ROWS[key.strip('`')].estimator}`" in text
