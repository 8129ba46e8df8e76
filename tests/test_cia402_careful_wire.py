"""What is looked at before drives are trusted, with mock drives in another process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from can_mock import MockCan, mock_can
from cia402_robot import options

from hil_drivers.cia402.axes_robot import AxesRobot

pytestmark = [pytest.mark.wire, pytest.mark.timeout(120)]

PATIENT = ("--sync-patience-s", "0.5", "--start-q-deg", "0", "-30", "-60", "0", "30", "0")


@pytest.fixture(scope="module")
def mock() -> Iterator[MockCan]:
    with mock_can(*PATIENT) as running:
        yield running


@contextmanager
def axes(mock: MockCan, **more: Any) -> Iterator[AxesRobot]:
    made = AxesRobot("arm", "lab6", **options(mock, **more))
    try:
        made.connect()
        yield made
    finally:
        made.close()


def finding(robot: AxesRobot, name: str) -> Any:
    (found,) = (each for each in robot.checks() if each.name == name)
    return found


def test_drives_without_the_mode_in_their_process_data_are_in_it_all_the_same(
    mock: MockCan,
) -> None:
    with axes(mock, mapping="minimal") as robot:
        assert set(mock.state()["modes"]) == {8}
        assert "does not carry it" in finding(robot, "drives-enabled").message
        rows = robot.read()
        assert np.isfinite(rows["qd"]).all()
        assert (rows["status"] == rows["status"][0]).all()
