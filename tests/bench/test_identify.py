"""`hil bench identify`: what it says on recorded data, and what it leaves out without them."""

import os
from pathlib import Path

import numpy as np
import pytest

from hil.cli.bench import TABLE_WIDTH, measure
from hil.data.dataset import Conditions, Dataset
from tests.support.paths import ROOT

DATA = Path(os.environ.get("HIL_DATA", ROOT.parent / "shared" / "data"))


def recorded(name: str):
    return pytest.mark.skipif(
        not (DATA / name).is_dir(),
        reason="the recorded robot data are not here: set HIL_DATA to their folder",
    )


@pytest.fixture(scope="module")
def quick():
    return measure("identify", quick=True)


@pytest.mark.thorough
@pytest.mark.data
@recorded("ur10e")
def test_wls_of_one_trajectory_is_the_published_baseline(quick) -> None:
    # facts measured by other code: WLS, tanh(qd/.01), 30s12h only.
    assert quick["figures"]["ur10e_wls_raw_a"] == pytest.approx(0.1485, rel=0.005)


@pytest.mark.thorough
@pytest.mark.data
@recorded("ur10e")
def test_load_is_weighed_without_having_been_weighed(quick) -> None:
    assert quick["figures"]["load_wls_controller_mass_kg"] == pytest.approx(2.805, rel=0.05)


@pytest.mark.thorough
@pytest.mark.data
@recorded("ur10e")
def test_tables_fit_a_hundred_columns(quick) -> None:
    for table in quick["tables"]:
        assert len(table["title"]) <= TABLE_WIDTH
        columns = zip(table["header"], *table["rows"], strict=True)
        widths = [max(map(len, column)) for column in columns]
        assert sum(widths) + 2 * (len(widths) - 1) <= TABLE_WIDTH, table["title"]


def test_absent_recordings_are_left_out_with_the_reason(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("HIL_DATA", str(tmp_path))
    document = measure("identify", quick=True)
    assert document["figures"] == {}
    assert all("set HIL_DATA" in reason for reason in document["skipped"].values())
    assert {"UR10e", "load"} <= document["skipped"].keys()


@pytest.fixture
def parts(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT))
    from benchmarks.identification import parts

    return parts


def swinging(samples: int, rate_hz: float) -> Dataset:
    """One joint at 2 Hz with a ripple at 0.45 of the sample rate on its effort."""
    t = np.arange(samples) / rate_hz
    q = np.sin(4 * np.pi * t)[:, None]
    effort = q + 0.5 * np.sin(2 * np.pi * 0.45 * rate_hz * t)[:, None]
    condition = Conditions("one", "trajectory", source="file", trajectory=0)
    columns = {"t": t, "q": q, "effort": effort}
    return Dataset("ur5", ("j",), "torque", columns, np.array([0, samples]), (condition,))


def test_parts_of_a_recording_share_no_row_and_keep_a_gap(parts) -> None:
    whole = swinging(1000, 100.0)
    train, test = parts.cut(whole)
    assert len(train) == pytest.approx(parts.TRAIN_SHARE * len(whole), abs=2)
    assert test["t"][0] - train["t"][-1] >= parts.GAP_S
    assert test["t"][-1] == whole["t"][-1]
    assert train.conditions[0].source != test.conditions[0].source


def test_thinning_keeps_the_motion_and_not_what_would_alias(parts) -> None:
    data = parts.thinned(swinging(2000, 1000.0), 100.0)
    inside = slice(10, -10)
    assert len(data) == 200
    np.testing.assert_allclose(data["effort"][inside], data["q"][inside], atol=1e-3)
    np.testing.assert_allclose(
        data["qd"][inside, 0], 4 * np.pi * np.cos(4 * np.pi * data["t"][inside]), atol=0.02
    )


def test_every_part_is_left_out_once_and_never_touches_what_is_learnt(parts) -> None:
    whole = swinging(1000, 100.0)
    judged = []
    for train, test in parts.in_turn(whole):
        judged += test["t"].tolist()
        apart = np.abs(train["t"][:, None] - test["t"][None]).min()
        assert apart >= parts.GAP_S - 1e-9
        for _, rows in train.slices():
            assert np.max(np.diff(train["t"][rows])) < 0.011
    assert sorted(set(judged)) == whole["t"].tolist()
