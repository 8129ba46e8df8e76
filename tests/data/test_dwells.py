"""Dwells are found in motion, and averaged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hil.data import Conditions, rows_of
from hil.data.dwells import RestRule, dwells_of, find_dwells, series_means
from tests.support.synthetic_motion import dataset, dwelling

RATE = 125.0


def stop_and_go(stay_s, moves=3, samples_between=60):
    """Smooth moves between standstills of the given lengths; returns t, q, qd and the stays."""
    q, stays, at = [], [], 0.0
    for stay in [*stay_s]:
        s = np.linspace(0, 1, samples_between)
        q.append(at + 0.3 * (3 * s**2 - 2 * s**3))
        at += 0.3
        rest = round(stay * RATE)
        start = sum(map(len, q))
        q.append(np.full(rest, at))
        stays.append((start, start + rest))
    q.append(at - 0.3 * np.linspace(0, 1, samples_between) ** 2)
    flat = np.concatenate(q)
    t = np.arange(len(flat)) / RATE
    return t, np.repeat(flat[:, None], 6, axis=1), np.gradient(flat, t), stays


def test_dwells_are_the_last_ten_samples_of_each_stay() -> None:
    t, q, qd, stays = stop_and_go([0.4, 0.2, 1.0])
    found = find_dwells(q, np.repeat(qd[:, None], 6, axis=1), t)
    assert len(found) == 3
    for span, (start, stop) in zip(found, stays, strict=True):
        assert span.stop - span.start == 10
        assert start <= span.start
        assert abs(span.stop - stop) <= 2


def test_stays_shorter_than_the_minimum_are_no_dwells() -> None:
    t, q, qd, _ = stop_and_go([0.4, 0.06, 0.4])
    assert len(find_dwells(q, np.repeat(qd[:, None], 6, axis=1), t)) == 2


def test_dwells_are_found_from_positions_alone() -> None:
    t, q, _, _ = stop_and_go([0.4, 0.2])
    assert len(find_dwells(q, None, t)) == 2


def test_creeping_joint_is_not_at_rest() -> None:
    t = np.arange(200) / RATE
    q = np.zeros((200, 6))
    q[:, 4] = 0.004 * t
    assert find_dwells(q, np.zeros((200, 6)), t, min_s=0.5, samples=80) == []


def test_dwells_of_a_motion_become_numbered_poses() -> None:
    t, q, qd, _ = stop_and_go([0.4, 0.3])
    columns = {"t": t, "q": q, "qd": np.repeat(qd[:, None], 6, axis=1), "effort": q}
    data = dataset(columns, [len(t)], [Conditions("a", "trajectory", "run", 4)])
    found = dwells_of(data)
    assert [(c.kind, c.pose, c.id) for c in found.conditions] == [
        ("dwell", 0, "a/dwell0"),
        ("dwell", 1, "a/dwell1"),
    ]
    assert found["q"][:10] == pytest.approx(0.3)
    assert found["q"][10:] == pytest.approx(0.6)


def test_planned_dwells_that_did_not_settle_are_left_out() -> None:
    data = dwelling(5)
    unsettled = tuple(
        Conditions(c.id, c.kind, c.source, pose=c.pose, settled=c.pose != 3)
        for c in data.conditions
    )
    found = dwells_of(replace(data, conditions=unsettled), RestRule())
    assert [c.pose for c in found.conditions] == [0, 1, 2, 4]


def test_series_without_rows_is_no_dwell_and_has_no_mean() -> None:
    data = dwelling(3)
    emptied = rows_of(data, np.repeat([True, False, True], 10))
    assert np.isnan(series_means(emptied, emptied["q"])[1]).all()
    assert [c.pose for c in dwells_of(emptied).conditions] == [0, 2]


def test_series_means_are_means_of_each_series() -> None:
    data = dwelling(7)
    expected = [data["effort"][rows].mean(axis=0) for _, rows in data.slices()]
    assert series_means(data, data["effort"]) == pytest.approx(np.array(expected))
