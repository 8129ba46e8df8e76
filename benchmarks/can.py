"""Six axes over a bus between processes, 19 frames a cycle: our cyclic core, canopen's PdoMaps.

A process of its own hosts the bus and answers for the drives, at no cost worth naming; the master
is another. All masters play the same motion with the same deadlines and priorities, in turns:
ours, canopen's as quick as it can be made, canopen's as documented; at 1 kHz also with the ordinary
priority, which is all that canopen ever asks for. Both ends: the drives' process is measured too,
light ones beside our master, canopen's LocalNodes beside canopen's; a third one hosts the bus.
`overrun` counts cycles that began late by over a quarter of a period, were not over when the next
was to begin, or lacked an answer. Times are medians over the rounds.
"""

from __future__ import annotations

import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.core.errors import RobotError

RATES_HZ = (250, 500, 1000)
SECONDS, QUICK_SECONDS = 0.8, 0.3
ROUNDS, QUICK_ROUNDS = 2, 1
OURS, TUNED, DOCUMENTED = ("ours",), ("pdo_maps",), ("pdo_maps", "documented")
ORDINARY = "ordinary"
PATHS = {
    "ours": (OURS, "host"),
    "canopen": (TUNED, "host"),
    "canopen_documented": (DOCUMENTED, "host"),
    "ours_ordinary": ((*OURS, ORDINARY), "host"),
    "canopen_documented_ordinary": ((*DOCUMENTED, ORDINARY), "host"),
    "both_ours": (OURS, "light"),
    "both_canopen": (DOCUMENTED, "canopen"),
    "both_ours_ordinary": ((*OURS, ORDINARY), "light_ordinary"),
    "both_canopen_ordinary": ((*DOCUMENTED, ORDINARY), "canopen_ordinary"),
}
"""The master, as a program in `benchmarks/can_bus` and what it is told; the drives."""

AT_ALL_RATES = ("ours", "canopen", "canopen_documented")
VIRTUAL = "both_canopen_ordinary_virtual"
BOTH_ENDS = ("", "_ordinary", "_ordinary_virtual")
MASTER_ONLY = {"tuned": "canopen", "documented": "canopen_documented"}

_ROOT = Path(__file__).resolve().parent.parent

Figures = dict[str, float]
Told = dict[tuple[str, int], list[Figures]]


@dataclass(frozen=True)
class End:
    """A bus with drives on it.

    Attributes:
        channel: Of the bus.
        pids: Whose CPU time is told, and as what.
    """

    channel: str
    pids: dict[str, int]

    def cpu_s(self) -> dict[str, float]:
        """CPU time of each until now, to the nanosecond; Linux [s]."""
        return {name: _cpu_s(pid) for name, pid in self.pids.items()}


def run(
    quick: bool = False,
    seconds: float | None = None,
    rounds: int | None = None,
    rates_hz: Sequence[int] = RATES_HZ,
) -> dict[str, Any]:
    """250, 500 and 1000 Hz; at 1000 Hz also both ends, and canopen's in one process.

    Args:
        quick: 0.3 s of each once instead of twice 0.8 s.
        seconds: So long instead.
        rounds: So often instead.
        rates_hz: These only; the last one is that of the ordinary priority, both ends and
            `virtual`.
    """
    seconds = seconds or (QUICK_SECONDS if quick else SECONDS)
    rounds = rounds or (QUICK_ROUNDS if quick else ROUNDS)
    most_hz, busy = rates_hz[-1], os.getloadavg()[0]
    turns = [(path, hz) for hz in rates_hz for path in PATHS if path in AT_ALL_RATES]
    turns += [(path, most_hz) for path in PATHS if path not in AT_ALL_RATES]
    told: Told = {}
    with _ends() as ends:
        for _ in range(rounds):
            for path, hz in turns:
                master, drives = PATHS[path]
                one = _master(master, hz, seconds, ends[drives])
                told.setdefault((path, hz), []).append(one)
    one = _master((*DOCUMENTED, ORDINARY), most_hz, seconds, End("virtual", {}))
    told[VIRTUAL, most_hz] = [one]
    figures = {
        "seconds": seconds,
        "rounds": float(rounds),
        "load_before": busy,
        "load_after": os.getloadavg()[0],
        "cores": float(os.cpu_count() or 1),
        "fifo": told["ours", rates_hz[0]][0]["fifo"],
    }
    for (path, hz), each in told.items():
        figures |= {f"{path}_{hz}hz_{name}": _median(each, name) for name in each[0]}
    return {"name": "can", "figures": figures, "ratios": _ratios(told, rates_hz)}


def _ratios(told: Told, rates_hz: Sequence[int]) -> Figures:
    """How many times less CPU time ours takes; both ends: of both, without that of the bus."""
    most_hz = rates_hz[-1]
    ratios = {
        f"cpu_master_only_vs_{name}_{hz}hz": _times_less(told["ours", hz], told[peer, hz])
        for name, peer in MASTER_ONLY.items()
        for hz in rates_hz
    }
    for how in BOTH_ENDS:
        ours = told["both_ours" + how.removesuffix("_virtual"), most_hz]
        theirs = told["both_canopen" + how, most_hz]
        ratios[f"cpu_both_ends{how}_{most_hz}hz"] = _times_less(ours, theirs, "both_cpu_us")
    return ratios


def _median(rounds: list[Figures], name: str) -> float:
    return statistics.median(one[name] for one in rounds)


def _times_less(ours: list[Figures], theirs: list[Figures], name: str = "cpu_us") -> float:
    """By rounds, because what disturbs one of them disturbs the other just after it."""
    pairs = zip(ours, theirs, strict=False)  # there is one round of `virtual`
    return statistics.median(peer[name] / mine[name] for mine, peer in pairs)


def _master(master: tuple[str, ...], rate_hz: int, seconds: float, drives: End) -> Figures:
    """One stretch of cycles, in a process of its own."""
    before = drives.cpu_s()
    program, *how = master
    arguments = [f"benchmarks.can_bus.{program}", drives.channel, str(rate_hz), str(seconds), *how]
    told = subprocess.run(
        [sys.executable, "-m", *arguments],
        check=True,
        stdout=subprocess.PIPE,
        text=True,
        timeout=seconds + 60,
        cwd=_ROOT,
        env=_alone(),
    )
    figures: Figures = json.loads(told.stdout.splitlines()[-1])
    cycles = figures.pop("cycles_in_all")
    for name, cpu_s in drives.cpu_s().items():
        figures[f"{name}_cpu_us"] = 1e6 * (cpu_s - before[name]) / cycles
    figures["both_cpu_us"] = figures["cpu_us"] + figures.get("drives_cpu_us", 0.0)
    return figures


@contextlib.contextmanager
def _ends() -> Iterator[dict[str, End]]:
    """All that answers, by name."""
    with contextlib.ExitStack() as stack:
        ends = {"host": stack.enter_context(_end("drives"))}
        for name, program in (("light", "light_drives"), ("canopen", "local_nodes")):
            for how in ((), (ORDINARY,)):
                this = _end("hub_alone", program, how=how)
                ends["_".join((name, *how))] = stack.enter_context(this)
        yield ends


@contextlib.contextmanager
def _end(*programs: str, how: tuple[str, ...] = ()) -> Iterator[End]:
    """Start what a bus needs, the one that hosts it first.

    Args:
        programs: In `benchmarks/can_bus`; the last one is the drives.
        how: They are told that as well.
    """
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        channel, pids = f"{folder}/bench.sock", dict[str, int]()
        for program in programs:
            name = "drives" if program is programs[-1] else "hub"
            pids[name] = stack.enter_context(_running(program, channel, *how))
        yield End(channel, pids)


def _alone() -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1"}


@contextlib.contextmanager
def _running(program: str, *arguments: str) -> Iterator[int]:
    running = subprocess.Popen(
        [sys.executable, "-m", f"benchmarks.can_bus.{program}", *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=_ROOT,
        env=_alone(),
    )
    assert running.stdin is not None
    assert running.stdout is not None
    try:
        if running.stdout.readline() != "ready\n":
            raise RobotError(
                f"the benchmark's {program} does not come up",
                hint=f"see what it says: python -m benchmarks.can_bus.{program} "
                + " ".join(arguments),
            )
        yield running.pid
    finally:
        running.stdin.close()
        running.wait(20)
        running.stdout.close()


def _cpu_s(pid: int) -> float:
    tasks = Path(f"/proc/{pid}/task").glob("*/schedstat")
    return 1e-9 * sum(int(task.read_text().split()[0]) for task in tasks)
