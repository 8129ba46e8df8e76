"""How far interlocks say they are from tripping: what people are shown, at the limit itself 0."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.core.typing import StructArray
from hil.engine.interlocks import (
    Backlog,
    Distances,
    FreeSpace,
    HasMargin,
    Interlock,
    InterlockContext,
    LeastDistance,
    Margin,
)
from tests.engine.test_interlocks_distances import Lever, bodies, space
from tests.support.interlock_parts import NAMES, made, rows, with_value


def margin_of(interlock: Interlock | LeastDistance, block: StructArray) -> Margin | None:
    assert isinstance(interlock, HasMargin)
    return interlock.margin(block)


def test_the_joint_nearest_to_its_own_limit_counts() -> None:
    interlock = made(kind="current", limit_a=[10, 10, 10, 2, 2, 2])
    block = with_value("effort", 1.5, row=3, joint=4)
    block["effort"][3, 0] = 5.0
    found = margin_of(interlock, block)
    assert found == Margin(1.5, 2.0, "A", 0.25, joint=4)


def test_only_the_last_row_counts() -> None:
    found = margin_of(made(kind="current", limit_a=10), with_value("effort", 9.0, row=2))
    assert found is not None
    assert found.share == 1.0


@pytest.mark.parametrize(("share", "trips"), [(1e-6, False), (0.0, True)])
def test_no_margin_is_left_where_it_trips(share: float, trips: bool) -> None:
    interlock = made(kind="speed", limit_deg_s=90)
    block = with_value("qd", np.pi / 2 * (1 - share + (1e-9 if trips else 0)), row=3)
    found = margin_of(interlock, block)
    assert found is not None
    assert found.share == pytest.approx(share, abs=1e-9)
    assert (interlock.check(block) is not None) is trips


def test_what_nobody_measures_has_no_margin() -> None:
    block = rows(temperature=np.nan)
    assert margin_of(made(kind="temperature", limit_c=60), block) is None
    lever = LeastDistance("lever", Lever(), 0.1)
    assert margin_of(lever, rows(q=np.nan)) is None


def test_an_infinite_limit_is_none() -> None:
    context = InterlockContext(
        joint_names=NAMES, effort_kind="torque", effort_max=(np.inf,) * 5 + (10.0,)
    )
    found = margin_of(made(context, kind="torque"), with_value("effort", 5.0, 3, 5))
    assert found is not None
    assert (found.joint, found.limit) == (5, pytest.approx(9.5))
    still = margin_of(made(context, kind="torque"), rows())
    assert still is not None, "standing still, a joint without a limit hides those that have one"
    assert (still.joint, still.share) == (5, 1.0)


def test_the_nearest_pair_counts() -> None:
    q = np.zeros((4, 6))
    q[-1, 0] = 1.7
    found = margin_of(LeastDistance("lever", Lever(), 0.1), rows(q=q))
    assert found is not None
    assert (found.subject, found.least) == ("lever and stop", True)
    assert (found.value, found.limit, found.share) == pytest.approx((150, 100, 0.5))


@pytest.mark.parametrize("measured", [bodies(), space()], ids=["clearance", "workspace"])
def test_looking_disturbs_no_judgement(measured: Distances) -> None:
    """It happens on another thread, at any time: nothing that judging keeps may change."""
    looked, alone = (LeastDistance("x", measured, -1.0) for _ in range(2))
    rng = np.random.default_rng(5)
    for _ in range(20):
        block = rows(4, q=rng.uniform(-2, 2, (4, 6)))
        margin_of(looked, rows(4, q=rng.uniform(-2, 2, (4, 6))))
        assert looked.check(block) == alone.check(block)
        assert looked.computed == alone.computed


def test_backlog_and_disk() -> None:
    backlog: Any = Backlog(lambda: 0.5, 2.0).margin(rows())
    assert (backlog.value, backlog.share) == (0.5, 0.75)
    disk = FreeSpace(Path, 500, free=lambda folder: 2_000_000_000)
    assert disk.margin(rows()) is None  # nobody has looked yet
    disk.check(rows())
    found: Any = disk.margin(rows())
    disk.close()
    assert (found.value, found.share) == (2000.0, 0.75)
