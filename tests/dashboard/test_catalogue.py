"""The catalogue in the dashboard: the same answers as `hil runs`, and pages of them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest.importorskip("starlette", reason='the dashboard: pip install "hil[web]"')

from starlette.testclient import TestClient

from hil.dashboard.catalogue import PER_PAGE
from tests.support.catalogue_runs import write_run
from tests.support.recorded import SLY
from tests.support.web_parts import dashboard, plain, seen


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> TestClient:
    """Sixty runs of two robots; one was tripped, one is damaged, one has a sly name."""
    folder = tmp_path_factory.mktemp("lab")
    root = folder / "runs"
    for number in range(1, 58):
        robot = "ur5" if number % 3 else "ur10"
        write_run(root, number, robot=robot, fits={"rigid-wls": 1.0 / number})
    write_run(root, 58, outcome="tripped", stop={"reason": "too much current"})
    damaged = write_run(root, 59)
    (damaged / "start.json").write_text("{")
    write_run(root, 60, start={"experiment": SLY, "operator": SLY}, description=SLY)
    return dashboard(folder)


def names(html: str) -> list[str]:
    """Of the runs in the table, in its order."""
    return re.findall(r'<th scope="row" class="run"><a [^>]*>([^<]*)</a>', html)


def test_the_newest_come_first_and_the_others_on_further_pages(lab: TestClient) -> None:
    first = seen(lab, "/runs")
    assert len(names(first)) == PER_PAGE
    assert names(first)[0] == "0060-fourier"
    second = seen(lab, "/runs?page=2")
    assert names(second) == [f"{n:04d}-fourier" for n in range(10, 0, -1)]
    assert "page 2 of 2" in plain(second)


def test_a_query_finds_what_hil_runs_finds(lab: TestClient) -> None:
    found = names(seen(lab, "/runs?q=robot%3Dur10+rmse%3C0.02"))
    assert found == ["0057-fourier", "0054-fourier", "0051-fourier"]


def test_a_query_that_cannot_be_understood_is_mended_beside_the_field(lab: TestClient) -> None:
    html = seen(lab, "/runs?q=rms%3C1", status=422)
    assert 'aria-invalid="true"' in html
    assert 'value="rms&lt;1"' in html
    assert "did you mean &#39;rmse&#39;?" in html
    assert names(html) == []


def test_nothing_found_says_what_to_do(lab: TestClient) -> None:
    assert "No run meets: robot=kuka" in plain(seen(lab, "/runs?q=robot%3Dkuka"))


def test_headings_sort_and_turn_round(lab: TestClient) -> None:
    best = seen(lab, "/runs?q=rmse%3C1&sort=rmse")
    assert names(best)[0] == "0057-fourier"
    assert 'aria-sort="ascending"' in best
    turned = re.search(r'href="([^"]*sort=rmse[^"]*)"', best)
    assert turned is not None
    assert names(seen(lab, turned[1].replace("&amp;", "&")))[0] == "0002-fourier"


def test_how_a_run_ended_is_said_in_words(lab: TestClient) -> None:
    html = seen(lab, "/runs?q=status%3Dtripped")
    assert '<span class="badge fail">tripped</span>' in html
    damaged = seen(lab, "/runs?q=status%3Ddamaged")
    assert "start.json" in plain(damaged)


@pytest.mark.parametrize(
    "odd", ["page=0", "page=99", "page=x", "sort=x", "order=x", "q=%00", "q='"]
)
def test_odd_addresses_are_pages_too(lab: TestClient, odd: str) -> None:
    seen(lab, f"/runs?{odd}")


def test_without_runs_it_says_how_to_make_one(tmp_path: Path) -> None:
    assert "hil run SPEC" in seen(dashboard(tmp_path), "/runs")


def test_who_may_only_look_is_not_asked_to_start_one(tmp_path: Path) -> None:
    assert "/start" not in seen(dashboard(tmp_path, read_only=True), "/runs")


@pytest.mark.parametrize(("rmse", "said"), [(4.658e-5, "0.0466 mA"), (0.115, "0.115 A")])
def test_an_error_is_said_without_exponents(tmp_path: Path, rmse: float, said: str) -> None:
    write_run(tmp_path / "runs", 1, fits={"rigid-wls": rmse})
    assert said in plain(seen(dashboard(tmp_path), "/runs"))


def test_a_folder_of_runs_that_is_a_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "runs").write_text("")
    assert "not a folder of runs" in plain(seen(dashboard(tmp_path), "/runs", status=422))


def test_a_run_by_a_link_is_listed_without_an_address(tmp_path: Path) -> None:
    real = write_run(tmp_path / "elsewhere", 7)
    (tmp_path / "runs/2026-11-20/ur5").mkdir(parents=True)
    (tmp_path / "runs/2026-11-20/ur5/0007-fourier").symlink_to(real)
    html = seen(dashboard(tmp_path), "/runs")
    assert "0007-fourier" in html
    assert names(html) == []
    assert "0007-fourier" in seen(dashboard(tmp_path), "/")
