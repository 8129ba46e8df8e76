"""A schedule that is killed again and again, and what it must have done by the end."""

from __future__ import annotations

import random
import subprocess
import sys
import time
from pathlib import Path

from hil.maintenance.ledger import Ledger
from tests.support.schedule_parts import require_accounts
from tests.support.schedule_worker import SPEC, main

WORKER = Path(main.__code__.co_filename)


def killed_at_random(folder: Path, kills: int, seed: int) -> Ledger:
    """Start and kill a schedule, let it come to an end, and look at what it has done."""
    dice, epoch = random.Random(seed), time.time()
    for _ in range(kills):
        worker = _worker(folder, epoch)
        time.sleep(dice.uniform(0.0, 0.4))
        assert worker.poll() is None, "it ended by itself"
        worker.kill()
        worker.communicate(timeout=20)
        Ledger.read(folder / "state")  # every line whole, and behind the one before it
        time.sleep(dice.choice((0.0, 0.0, 0.7)))
    last = _worker(folder, epoch, "60")
    last.communicate(timeout=60)
    assert last.returncode == 0
    ledger = Ledger.read(folder / "state")
    _look(ledger, (folder / "journal").read_text().splitlines(), kills)
    return ledger


def _worker(folder: Path, epoch: float, *more: str) -> subprocess.Popen[str]:
    paths = (str(folder / "state"), str(folder / "journal"), str(epoch))
    command = [sys.executable, str(WORKER), *paths, *more]
    worker = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert worker.stdout is not None
    assert worker.stdout.readline() == "ready\n"
    return worker


def _look(ledger: Ledger, journal: list[str], kills: int) -> None:
    require_accounts(SPEC, ledger)
    done = [line["occasion"] for line in ledger.lines if line["event"] == "done"]
    assert len(done) > kills
    assert len(set(done)) == len(done)
    begun: list[str] = []
    for line in journal:
        what, _, which = line.partition(" ")
        # Nothing else is begun while one is open, and none again after its end.
        if what == "begin" and (not begun or begun[-1] != which):
            assert which not in begun
            begun.append(which)
    gone_on = [line for line in ledger.lines if line.get("again")]
    assert 1 <= len(gone_on) <= kills
    assert {line["event"] for line in ledger.lines} >= {"started", "begun", "done", "missed"}
    left = [line for line in ledger.lines if line["event"] == "missed"]
    assert set(begun) - set(done) <= {line["occasion"] for line in left}
