"""Terms of `hil runs`: what they find, and what is said of those that ask nothing."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core.errors import SpecError
from hil.runs.catalogue import find_runs
from hil.runs.query import parse
from tests.support.catalogue_runs import write_run


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("runs")
    write_run(root, 1, fits={"rigid-wls": 0.2, "static-wls": 0.05}, description="Elbow, new grease")
    write_run(root, 2, robot="ur5-b", name="dwell", outcome="tripped", stop={"gaps": 3})
    write_run(root, 3, day="2026-11-21", outcome=None, start={"operator": "Grace"})
    write_run(
        root, 4, day="2026-11-22", robot="ur10", fits={"rigid-wls": 0.08},
        start={"loads": [{"mass_kg": 0}, {"mass_kg": 3.5}], "occasion": "weekly/07/probe"},
    )  # fmt: skip
    return root


@pytest.mark.parametrize(
    ("query", "numbers"),
    [
        ("robot=ur5", [1, 3]),
        ("robot=ur5*", [1, 2, 3]),
        ("robot!=ur5", [2, 4]),
        ("robot!=ur5*", [4]),
        ("arm=ur5", [1, 2, 3, 4]),
        ("serial=ur10-s", [4]),
        ("name=dwell", [2]),
        ("run=000[12]-*", [1, 2]),
        ("outcome=completed", [1, 4]),
        ("status=interrupted", [3]),
        ("verdict=not judged", [1, 2, 3, 4]),
        ("operator=Grace", [3]),
        ("occasion=weekly/*", [4]),
        ("uid=uid-ur5-1", [1]),
        ("number>=3", [3, 4]),
        ("duration>61", [2, 4]),
        ("duration<1.05min", [1, 2, 3]),
        ("gaps>0", [2]),
        ("load>2", [4]),
        ("rmse<0.1", [1, 4]),
        ("estimator=rigid-wls rmse<0.1", [4]),
        ("estimator=rigid-*", [1, 4]),
        ("estimator!=static-wls", [2, 3, 4]),
        ("since=2026-11-21", [3, 4]),
        ("until=2026-11-20", [1, 2]),
        ("since=2026-11-20T00:02+00:00 until=2026-11-21T00:03:01+00:00", [2, 3]),
        ("GREASE", [1]),
        ("grace", [3]),
        ("robot=ur5* dwell", [2]),
        ("robot=nobody", []),
        ("", [1, 2, 3, 4]),
    ],
)
def test_a_query_finds(query: str, numbers: list[int], runs: Path) -> None:
    # `verdict=not judged` is one term, as a shell with quotes would hand it over.
    terms = [query] if query.startswith("verdict") else query.split()
    assert [run["number"] for run in find_runs(*terms, runs=runs)] == numbers


def test_durations_count_back_from_now() -> None:
    day = 86_400.0
    assert parse(["since=7d"], now=100 * day).values == (93 * day,)
    assert parse(["until=1h30min"], now=5400.0).values == (0.0,)


@pytest.mark.parametrize(
    ("term", "told"),
    [
        ("robt=ur5", "did you mean 'robot'?"),
        ("rmse", "in quotes: 'rmse<0.1'"),
        ("duration", "in quotes: 'duration>10'"),
        ("since", "in quotes: 'since=7d'"),
        ("rmse<", "for example: rmse<0.1"),
        ("rmse<low", "for example: rmse<0.1"),
        ("gaps>nan", "for example: gaps>10"),
        ("status=complete", "did you mean 'completed'?"),
        ("verdict=good", "available: not judged, passed, rejected"),
        ("name<b", "use name with = or !="),
        ("since>7d", "use since with ="),
        ("since=lately", "since=7d"),
        ("until=99999999d", "until=7d"),
    ],
)
def test_a_term_that_asks_nothing_is_refused_with_a_way_out(term: str, told: str) -> None:
    with pytest.raises(SpecError) as caught:
        parse([term])
    assert term in caught.value.message
    assert told in caught.value.hint


ODD = st.characters(codec=None, exclude_categories=())


@given(st.lists(st.text(ODD, max_size=12), max_size=3))
def test_no_text_becomes_sql(texts: list[str]) -> None:
    shell = sqlite3.connect(":memory:")
    shell.execute("CREATE TABLE runs (path, entry, words, name, robot)")
    shell.execute("CREATE TABLE fits (path, estimator, rmse)")
    terms = [f"{key}={text}" for key, text in zip(("name", "robot", "estimator"), texts)]  # noqa: B905
    try:
        query = parse([*terms, *texts])
    except SpecError:
        return
    assert shell.execute(query.select, query.values).fetchall() == []
    shell.close()


def test_the_command_prints_what_was_found(runs: Path) -> None:
    told = CliRunner().invoke(app, ["runs", "rmse<0.1", "--runs", str(runs), "--json"])
    assert [run["number"] for run in json.loads(told.stdout)] == [1, 4]
    table = CliRunner().invoke(app, ["runs", "number=4", "--runs", str(runs)]).stdout
    assert "ur10-s" in table
    assert "rigid-wls 0.0800 A" in table
    nothing = CliRunner().invoke(app, ["runs", "number=5", "--runs", str(runs)])
    assert nothing.stdout == f"no run under {runs} meets the conditions: number=5\n"


def test_without_a_query_the_command_says_what_it_always_said(runs: Path) -> None:
    told = CliRunner().invoke(app, ["runs", "--runs", str(runs), "--json"])
    assert list(json.loads(told.stdout)[0]) == [
        "run", "status", "robot", "date", "uid", "duration_s", "verdict", "studies", "problem",
        "next",
    ]  # fmt: skip
