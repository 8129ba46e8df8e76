"""A process that keeps a schedule until it is killed; a minute of it takes a few milliseconds.

python schedule_worker.py STATE JOURNAL EPOCH [MINUTES]

EPOCH is when the schedule's time began, as a Unix time; the process ends when it has kept the
schedule for MINUTES of it: how long Python took to start is not counted.
"""

from __future__ import annotations

import random
import sys
import time
from collections.abc import Mapping
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from hil.maintenance.ledger import Occasion, open_ledger
from hil.maintenance.scheduler import Scheduler
from tests.support.schedule_parts import MONDAY, schedule

QUICKER = 3000.0
"""The clock's minute takes 20 ms."""

SPEC = schedule(
    name="dies",
    probe={"spec": "p", "every": "2min"},
    campaign={"spec": "c", "every": "7min"},
    blackout=[{"begin": "06:00", "end": "06:05"}],
    missed_within="12h",
)


class Quick:
    """A clock that goes on, quicker, while nobody looks."""

    def __init__(self, epoch: float) -> None:
        self._epoch = epoch

    def now(self) -> datetime:
        """What it shows."""
        return MONDAY + timedelta(seconds=(time.time() - self._epoch) * QUICKER)

    def sleep_until(self, moment: datetime) -> None:
        """Wait."""
        time.sleep(max(0.0, (moment - self.now()).total_seconds() / QUICKER))


def main() -> None:
    """Keep it."""
    state, journal, epoch = Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3])
    clock = Quick(epoch)

    def say(text: str) -> None:
        with journal.open("a") as file:
            file.write(f"{text}\n")

    def work(occasion: Occasion, folder: Path) -> Mapping[str, Any]:
        say(f"begin {occasion.id}")
        for stage in range(3):
            if not (folder / str(stage)).exists():
                time.sleep(random.uniform(0.0, 0.05))
                (folder / str(stage)).write_text("")
        say(f"end {occasion.id}")
        return {"outcome": "quiet", "text": "done"}

    end = clock.now() + timedelta(minutes=float(sys.argv[4])) if len(sys.argv) > 4 else None
    with open_ledger(state, SPEC.name) as ledger:
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        Scheduler(SPEC, ledger, work, clock).run(end)


if __name__ == "__main__":
    main()
