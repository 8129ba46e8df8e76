"""How real runs end a schedule's occasion: an interlock holds it, Ctrl-C stops at once."""

from __future__ import annotations

import os
import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from hil.core.errors import Stopped
from hil.maintenance.ledger import Ledger, Occasion
from hil.maintenance.reidentifying import Measuring
from hil.maintenance.scheduler import Scheduler
from hil.planning.experiment import load as load_experiment
from tests.support.pipeline_parts import PROBE, write_schedule
from tests.support.schedule_parts import at, events, schedule, scheduler

MON = "20261123T030000Z-probe"


class Presses:
    """Presses Ctrl-C when the robot begins to move, and again if that only pauses it."""

    wants_rows = False

    def __init__(self) -> None:
        self.heard: list[str] = []

    def notify(self, event: Mapping[str, Any]) -> None:
        """An event of the run."""
        what = event.get("state", "") if event["kind"] == "state" else event["kind"]
        if what in ("step", "paused") and what not in self.heard:
            self.heard.append(what)
            os.kill(os.getpid(), signal.SIGINT)


def measuring(folder: Path, probe: Any, *observers: Presses) -> Scheduler:
    """A schedule whose work is one real run of a program."""
    write_schedule(folder, probe=probe)
    experiment = load_experiment(folder / "probe.yaml")
    runs = Measuring(folder / "runs", observers=observers)

    def work(occasion: Occasion, _: Path) -> Mapping[str, Any]:
        run = runs.measure(experiment, occasion.id)
        return {"outcome": "quiet", "text": str(run)}

    loop, _, _ = scheduler(schedule(), ledger=Ledger(folder))
    loop.work = work
    return loop


@pytest.mark.thorough
def test_an_interlock_holds_the_schedule(tmp_path: Path) -> None:
    loop = measuring(tmp_path, PROBE | {"interlocks": [{"kind": "current", "limit_a": 0.5}]})
    loop.run(at("25 12:00"))
    assert events(loop.ledger)[1:] == [("begun", MON), ("held", MON)]
    assert loop.ledger.lines[-1]["kind"] == "InterlockTripped"
    assert len(list(tmp_path.glob("runs/*/*/*/start.json"))) == 1


@pytest.mark.thorough
def test_the_first_ctrl_c_stops_what_nobody_attends(tmp_path: Path) -> None:
    presses = Presses()
    loop = measuring(tmp_path, PROBE, presses)
    with pytest.raises(Stopped) as stopped:
        loop.run(at("24 00:00"))
    assert stopped.value.by_signal
    assert presses.heard == ["step"]
    assert events(loop.ledger)[1:] == [("begun", MON)]  # and is gone on with at the next start
