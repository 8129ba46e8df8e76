"""Whether a robot may be used now: asked before anything moves."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.core.errors import RobotConnectionError, RobotFault, Stopped
from hil.maintenance.scheduler import Interruption, RobotReady, interrupt_at
from hil.planning import robots
from hil.planning.experiment import load as load_experiment
from hil.robot import Finding, Status, state_dtype
from hil.robot.lease import leased
from hil.workflow import checks
from tests.support.paths import EXPERIMENTS

SPEC = EXPERIMENTS / "ci_fourier_2.yaml"


class Arm:
    """A robot in wall time that can be asked and does not move."""

    resource = "arm@bench"
    connects: Exception | None = None
    findings: Sequence[Finding] = ()

    def __init__(self) -> None:
        self.state = np.zeros(1, state_dtype(6))
        self.closed = 0

    @property
    def capabilities(self) -> Any:
        """In wall time."""
        return checks.Capabilities(  # the rest does not matter here
            joint_names=tuple("abcdef"),
            rate_hz=125.0,
            effort_kind="current",
            drive_gains=(10.0,) * 6,
            clock="wall",
        )

    def connect(self) -> None:
        """Or not."""
        if self.connects:
            raise self.connects

    def read(self) -> Any:
        """One row."""
        return self.state

    def checks(self) -> Sequence[Finding]:
        """What it has found."""
        return self.findings

    def close(self) -> None:
        """Count."""
        self.closed += 1


@pytest.fixture
def arm(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Arm:
    made = Arm()
    monkeypatch.setenv("HIL_LEASES", str(tmp_path))
    monkeypatch.setattr(robots, "open_robot", lambda name, described: made)
    return made


def ready(wait_s: float = 0.0) -> str:
    return RobotReady(load_experiment(SPEC), wait_s)()


def test_a_robot_at_rest_without_a_fault_is_ready(arm: Arm) -> None:
    assert ready() == ""
    assert arm.closed


def test_what_keeps_it_from_being_used_is_told(arm: Arm) -> None:
    arm.state["status"], arm.state["fault_code"] = int(Status.FAULT), 7
    arm.state["qd"][0, 2] = 0.5
    arm.findings = [Finding("remote", False, "it is in local control"), Finding("load", True, "")]
    assert ready() == (
        "the controller reports fault code 7; its fastest joint moves at 0.5000 rad/s; "
        "it is in local control"
    )


@pytest.mark.parametrize("error", [RobotFault("protective stop"), RobotConnectionError("no route"),
                                   RuntimeError("a bug")])  # fmt: skip
def test_a_robot_that_does_not_connect_is_not_ready(arm: Arm, error: Exception) -> None:
    arm.connects = error
    assert str(error) in ready()


def test_a_robot_that_somebody_holds_is_waited_for(arm: Arm) -> None:
    experiment = load_experiment(SPEC)
    station = experiment.station_source
    held = leased(arm, name="x", driver="d", station=station)  # type: ignore[arg-type]
    with held:
        assert "is held by pid" in ready()
        threading.Timer(0.4, held.release).start()
        assert ready(wait_s=20) == ""


def test_an_embedded_mock_is_always_ready() -> None:
    assert ready() == ""


def test_a_driver_that_is_not_there_is_told() -> None:
    experiment = load_experiment(SPEC)
    broken = replace(experiment, robot=experiment.robot.model_copy(update={"driver": "none"}))
    assert "none" in RobotReady(broken)()


def soon(seconds: float) -> datetime:
    return datetime.now(UTC) + timedelta(seconds=seconds)


def test_a_blackout_interrupts_what_is_done() -> None:
    begin = time.monotonic()
    with pytest.raises(Interruption), interrupt_at(soon(0.2)):
        time.sleep(20)
    assert time.monotonic() - begin < 5


def test_a_run_that_was_stopped_for_it_is_interrupted() -> None:
    heard: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, frame: heard.append(number))

    def run() -> None:
        while not heard:
            time.sleep(0.01)
        raise Stopped("stopped by SIGTERM", by_signal=True)

    with pytest.raises(Interruption), interrupt_at(soon(0.1)):
        run()


def test_what_ends_before_it_ends_as_it_does() -> None:
    with interrupt_at(soon(60)):
        pass
    with interrupt_at(None):
        pass
    with pytest.raises(Stopped), interrupt_at(soon(60)):
        raise Stopped("by hand", by_signal=True)


def test_sigterm_means_again_what_it_meant() -> None:
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    with interrupt_at(soon(60)):
        assert signal.getsignal(signal.SIGTERM) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
