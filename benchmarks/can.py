"""Six axes over a bus between processes, 19 frames a cycle: our cyclic core, canopen's PdoMaps.

A process of its own hosts the bus and answers for the drives, at no cost worth naming; the master
is another. All masters play the same motion with the same deadlines and priorities, in turns:
ours, canopen's as quick as it can be made, canopen's as documented; at 1 kHz also with the ordinary
priority, which is all that canopen ever asks for.
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
from pathlib import Path
from typing import Any

from hil.errors import RobotError

RATES_HZ = (250, 500, 1000)
SECONDS, QUICK_SECONDS = 1.3, 0.6
ROUNDS, QUICK_ROUNDS = 3, 1
MASTERS = {
    "ours": ("ours",),
    "canopen": ("pdo_maps",),
    "canopen_documented": ("pdo_maps", "documented"),
    "ours_ordinary": ("ours", "ordinary"),
    "canopen_documented_ordinary": ("pdo_maps", "documented", "ordinary"),
}
"""Program in `benchmarks/can_bus`, and what it is told."""

OURS, PEERS = "ours", ("canopen", "canopen_documented")
ORDINARY = ("ours_ordinary", "canopen_documented_ordinary")
VIRTUAL = "canopen_virtual"
_ROOT = Path(__file__).resolve().parent.parent

Figures = dict[str, float]


def run(
    quick: bool = False,
    seconds: float | None = None,
    rounds: int | None = None,
    rates_hz: Sequence[int] = RATES_HZ,
) -> dict[str, Any]:
    """250, 500 and 1000 Hz, and 1000 Hz with canopen on both ends of python-can's `virtual`.

    Args:
        quick: 0.6 s of each once instead of three times 1.3 s.
        seconds: So long instead.
        rounds: So often instead.
        rates_hz: These only; the last one is that of the ordinary priority and `virtual`.
    """
    seconds = seconds or (QUICK_SECONDS if quick else SECONDS)
    rounds = rounds or (QUICK_ROUNDS if quick else ROUNDS)
    busy = os.getloadavg()[0]
    turns = [(path, rate_hz) for rate_hz in rates_hz for path in (OURS, *PEERS)]
    turns += [(path, rates_hz[-1]) for path in ORDINARY]
    told: dict[tuple[str, int], list[Figures]] = {}
    with _drives() as (channel, pid):
        for _ in range(rounds):
            for turn in turns:
                told.setdefault(turn, []).append(_master(*turn, channel, seconds, pid))
    told[VIRTUAL, rates_hz[-1]] = [_master("canopen", rates_hz[-1], "virtual", seconds)]
    figures = {
        "seconds": seconds,
        "rounds": float(rounds),
        "load_before": busy,
        "cores": float(os.cpu_count() or 1),
        "fifo": told[OURS, rates_hz[0]][0]["fifo"],
    }
    for (path, rate_hz), each in told.items():
        figures |= {f"{path}_{rate_hz}hz_{name}": _median(each, name) for name in each[0]}
    ratios = {
        f"cpu_vs_{peer}_{hz}hz": _times_less(told[OURS, hz], told[peer, hz])
        for peer in PEERS
        for hz in rates_hz
    }
    return {"name": "can", "figures": figures, "ratios": ratios}


def _median(rounds: list[Figures], name: str) -> float:
    return statistics.median(one[name] for one in rounds)


def _times_less(ours: list[Figures], theirs: list[Figures]) -> float:
    """By rounds, because what disturbs one of them disturbs the other just after it."""
    pairs = zip(ours, theirs, strict=True)
    return statistics.median(peer["cpu_us"] / mine["cpu_us"] for mine, peer in pairs)


def _master(
    path: str, rate_hz: int, channel: str, seconds: float, drives: int | None = None
) -> Figures:
    """One stretch of cycles, in a process of its own."""
    before = _cpu_s(drives)
    program, *how = MASTERS[path]
    arguments = [f"benchmarks.can_bus.{program}", channel, str(rate_hz), str(seconds), *how]
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
    if drives is not None:
        figures["drives_cpu_us"] = 1e6 * (_cpu_s(drives) - before) / cycles
    return figures


@contextlib.contextmanager
def _drives() -> Iterator[tuple[str, int]]:
    """Bus and drives: the channel, and their process."""
    with tempfile.TemporaryDirectory() as folder:
        channel = f"{folder}/bench.sock"
        drives = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.can_bus.drives", channel],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=_ROOT,
            env=_alone(),
        )
        assert drives.stdin is not None
        assert drives.stdout is not None
        try:
            if drives.stdout.readline() != "ready\n":
                raise RobotError(
                    "the drives of the benchmark do not come up",
                    hint=f"see what they say: python -m benchmarks.can_bus.drives {channel}",
                )
            yield channel, drives.pid
        finally:
            drives.stdin.close()
            drives.wait(20)
            drives.stdout.close()


def _alone() -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1"}


def _cpu_s(pid: int | None) -> float:
    """CPU time of the only thread of a process, to the nanosecond; Linux [s]."""
    if pid is None:
        return 0.0
    return 1e-9 * int(Path(f"/proc/{pid}/schedstat").read_text().split()[0])
