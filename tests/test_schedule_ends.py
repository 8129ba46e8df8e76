"""How real runs end a schedule's occasion: an interlock holds it, Ctrl-C stops at once."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from pipeline_parts import PROBE, write_schedule
from schedule_parts import at, events, schedule, scheduler

from hil.campaign.experiment import load_experiment
from hil.engine import Engine
from hil.errors import Stopped
from hil.pipeline.measuring import Measuring
from hil.schedule.ledger import Ledger
from hil.schedule.loop import Scheduler
from hil.schedule.occasion import Occasion

MON = "20261123T030000Z-probe"


def measuring(folder: Path, probe: Any) -> Scheduler:
    """A schedule whose work is one real run of a program."""
    write_schedule(folder, probe=probe)
    experiment, runs = load_experiment(folder / "probe.yaml"), Measuring(folder / "runs")

    def work(occasion: Occasion, _: Path) -> Mapping[str, Any]:
        run = runs.measure(experiment, occasion.id)
        return {"outcome": "quiet", "text": str(run)}

    loop, _, _ = scheduler(schedule(), ledger=Ledger(folder))
    loop.work = work
    return loop


def test_an_interlock_holds_the_schedule(tmp_path: Path) -> None:
    loop = measuring(tmp_path, PROBE | {"interlocks": [{"kind": "current", "limit_a": 0.5}]})
    loop.run(at("25 12:00"))
    assert events(loop.ledger)[1:] == [("begun", MON), ("held", MON)]
    assert loop.ledger.lines[-1]["kind"] == "InterlockTripped"
    assert len(list(tmp_path.glob("runs/*/*/*/start.json"))) == 1


def test_the_first_ctrl_c_stops_what_nobody_attends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    execute = Engine._execute_plan

    def signalled(self: Engine, preflight: Callable[[], object]) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        execute(self, preflight)

    monkeypatch.setattr(Engine, "_execute_plan", signalled)
    loop = measuring(tmp_path, PROBE)
    with pytest.raises(Stopped) as stopped:
        loop.run(at("24 00:00"))
    assert stopped.value.by_signal
    assert events(loop.ledger)[1:] == [("begun", MON)]  # and is gone on with at the next start
