"""A schedule with two occasions; in the second one it is killed again and again until it is done.

python pipeline_dies.py FOLDER SEED LIVES

Children run the schedule's loop, which does the work; they are forked from a process that has
imported everything, so that a life costs little. A child dies by SIGKILL at a random operation on
files below FOLDER or, every third time, at a random moment. Says as JSON how many lives it took;
what the work returned is beside it.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sys
import threading
import traceback
from pathlib import Path
from typing import Any

import numpy as np

from hil.maintenance.binding import bind
from hil.maintenance.ledger import Occasion, open_ledger
from hil.maintenance.reidentifying import reidentification
from hil.maintenance.scheduler import Scheduler, VirtualClock
from hil.maintenance.simulation import with_options
from hil.models.model_registry import Registry
from hil.planning.experiment import Experiment
from hil.spec.schedule import load_schedule_spec
from hil.workflow.checks import check_driver
from tests.support.pipeline_parts import SCHEDULE, occasion, write_schedule

MOST_OPERATIONS = 200
"""The campaign alone takes 130."""
LONGEST_S = 3.0
WORN = [1.0, 1.6, 1.0, 1.0, 1.0, 1.0]
DAYS = {"probe": 0, "campaign": 1, "check": 2}
TWICE = SCHEDULE | {
    "probe": {"spec": "probe.yaml", "cron": "0 3 2 1 *"},
    "campaign": {"spec": "campaign.yaml", "cron": "0 3 9 1 *"},
}
"""Due when the two occasions are."""


def die_at(folder: Path, operation: int) -> None:
    """Kill this process at an operation on files; counted from now on."""
    left = [operation]

    def hook(event: str, given: tuple[Any, ...]) -> None:
        if event not in ("open", "os.rename", "os.mkdir", "os.remove"):
            return
        if str(given[0]).startswith(str(folder)) or event == "os.rename":
            left[0] -= 1
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)


def die_after(seconds: float) -> None:
    """Kill this process at a moment."""
    timer = threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGKILL))
    timer.daemon = True
    timer.start()


def adapt(experiment: Experiment, due: Occasion, stage: str) -> Experiment:
    """The arm has worn before the second occasion, and no two runs have the same noise."""
    first = due == occasion(0)
    day = 10 * (not first) + DAYS[stage]
    return with_options(experiment, {"day": day, "wear": [1.0] * 6 if first else WORN})


def do(folder: Path, due: Occasion) -> None:
    """What is due then; what the work returns is kept beside it."""
    spec = load_schedule_spec(folder / "weekly.yaml")
    registry, runs = Registry(folder / "registry"), folder / "runs"
    work = reidentification(spec, registry=registry, runs=runs, adapt=adapt)
    with open_ledger(folder, spec.name) as ledger:
        loop = Scheduler(spec, ledger, work, VirtualClock(due.due))
        loop.run_due()
        if loop.failure is not None:
            raise loop.failure
        told = next(line["result"] for line in ledger.lines[::-1] if line["event"] == "done")
    (folder / f"{due.id}.json").write_text(json.dumps(told), "utf-8")


def life(folder: Path, due: Occasion, operation: int = 0, seconds: float = 0.0) -> bool:
    """One child; whether it came to the end."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            if operation:
                die_at(folder, operation)
            if seconds:
                die_after(seconds)
            do(folder, due)
            code = 0
        except BaseException:  # told here: nothing goes on behind a fork
            traceback.print_exc()
        finally:
            os._exit(code)
    _, status = os.waitpid(child, 0)
    if os.WIFEXITED(status) and os.WEXITSTATUS(status):
        raise SystemExit("the work failed by itself")
    return os.WIFEXITED(status)


def main() -> None:
    folder, lives = Path(sys.argv[1]), int(sys.argv[3])
    dice = random.Random(int(sys.argv[2]))
    file = write_schedule(folder, schedule=TWICE)
    for one in bind(load_schedule_spec(file)).experiments:
        check_driver(one)
    np.linalg.inv(np.eye(3))
    life(folder, occasion(0))
    used = 1
    while used < lives:
        if used % 3 == 0:
            through = life(folder, occasion(1, "campaign"), seconds=dice.uniform(0.05, LONGEST_S))
        else:
            k = dice.randint(1, MOST_OPERATIONS)
            through = life(folder, occasion(1, "campaign"), operation=k)
        if through:
            break
        used += 1
    else:
        life(folder, occasion(1, "campaign"))
    print(json.dumps({"lives": used}))  # noqa: T201


if __name__ == "__main__":
    main()
