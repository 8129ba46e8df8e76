"""Taking every state a mock UR controller sends: our RTDE reader against ur-rtde's."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from hil.core.errors import RobotError
from hil.core.typing import FloatArray, StructArray
from hil_drivers.ur.rtde import Receiver

SECONDS, QUICK_SECONDS = 20.0, 3.0
SETTLE_S = 2.0
POLL_S = 2e-4
"""How often the peer is asked for its newest state: ten times per state at 500 Hz [s]."""

PEER = """
import json, sys, time, rtde_receive
seconds, poll = float(sys.argv[2]), float(sys.argv[3])
robot = rtde_receive.RTDEReceiveInterface(sys.argv[1])
seen, last, cpu, until = 0, robot.getTimestamp(), time.process_time(), time.monotonic() + seconds
first = last
while time.monotonic() < until:
    now = robot.getTimestamp()
    if now != last:
        seen, last = seen + 1, now
    time.sleep(poll)
print(json.dumps([seen, last - first, (time.process_time() - cpu) / seconds]), flush=True)
import os
os._exit(0)
"""
"""A process of its own: its constructors hold the interpreter, and its destructors take seconds."""

_numbers = count(1)


def run(quick: bool = False) -> dict[str, Any]:
    """Real time at 500 Hz (e-Series) and free run (CB3), everything there is to be told.

    Args:
        quick: 3 s of each instead of 20 s.
    """
    seconds = QUICK_SECONDS if quick else SECONDS
    real = _ours("ur5e", "1", seconds)
    free = _ours("ur5", "free", seconds)
    figures = {
        "seconds": seconds,
        "variables": real["variables"],
        "package_bytes": real["bytes"],
        **{f"real_{name}": real[name] for name in _TOLD},
        **{f"free_{name}": free[name] for name in ("states_per_s", "missing", "cpu", "mock_cpu")},
    }
    ratios = {
        "free_run_factor": free["factor"],
        # What it would be had the mock a core to itself: a shared machine gives it less.
        "free_run_factor_per_core": free["factor"] / free["mock_cpu"],
    }
    if find_spec("rtde_receive") is not None:
        theirs, faster = _peer("ur5e", "1", seconds, 500.0), _peer("ur5", "free", seconds, 125.0)
        figures |= {
            "ur_rtde_real_lost_share": theirs["lost"],
            "ur_rtde_real_cpu": theirs["cpu"],
            "ur_rtde_free_lost_share": faster["lost"],
            "ur_rtde_free_run_factor": faster["factor"],
        }
        ratios |= {"cpu_vs_ur_rtde": theirs["cpu"] / real["cpu"]}
    return {"name": "rtde", "figures": figures, "ratios": ratios}


_TOLD = ("states_per_s", "missing", "late_p50_ms", "late_p99_ms", "late_max_ms", "cpu", "mock_cpu")


def _ours(model: str, speed: str, seconds: float) -> dict[str, float]:
    with _mock(model, speed) as (address, pid), Receiver(address) as receiver:
        _take(receiver, SETTLE_S)
        cpu, theirs, wall = time.process_time(), _cpu_of(pid), time.monotonic()
        missing, rows = receiver.counts.missing, _take(receiver, seconds)
        took = time.monotonic() - wall
        late = 1e3 * _lateness(rows)
        return {
            "variables": float(len(receiver.dtype.names or ()) - 1),
            "bytes": float(receiver.dtype.itemsize - 8 + 4),
            "states_per_s": len(rows) / took,
            "missing": float(receiver.counts.missing - missing),
            "late_p50_ms": float(np.percentile(late, 50)),
            "late_p99_ms": float(np.percentile(late, 99)),
            "late_max_ms": float(late.max()),
            "factor": float(rows["timestamp"][-1] - rows["timestamp"][0]) / took,
            "cpu": (time.process_time() - cpu) / took,
            "mock_cpu": (_cpu_of(pid) - theirs) / took,
        }


def _take(receiver: Receiver, seconds: float) -> StructArray:
    blocks, until = [], time.monotonic() + seconds
    while time.monotonic() < until:
        blocks.append(receiver.take(5.0)[["host_time", "timestamp"]])
    return np.concatenate(blocks)


def _lateness(rows: StructArray) -> FloatArray:
    """(N,) how much later than the earliest of its second, by the robot's clock, each came [s].

    By seconds, because a mock that gets no CPU time for long sets its clock back for good.
    """
    behind = rows["host_time"] - rows["timestamp"]
    second = (rows["timestamp"] - rows["timestamp"][0]).astype(np.int64)
    earliest = np.full(second[-1] + 1, np.inf)
    np.minimum.at(earliest, second, behind)
    return np.asarray(behind - earliest[second])


def _peer(model: str, speed: str, seconds: float, rate_hz: float) -> dict[str, float]:
    with _mock(model, speed) as (address, _):
        time.sleep(SETTLE_S)
        told = subprocess.run(
            [sys.executable, "-c", PEER, address, str(seconds), str(POLL_S)],
            check=True,
            capture_output=True,
            text=True,
            timeout=seconds + 60,
        )
    seen, device_s, cpu = json.loads(told.stdout.splitlines()[-1])
    return {
        "lost": max(0.0, 1.0 - seen / (device_s * rate_hz)),
        "factor": device_s / seconds,
        "cpu": cpu,
    }


@contextlib.contextmanager
def _mock(model: str, speed: str) -> Iterator[tuple[str, int]]:
    """Start a mock controller; return its address and process."""
    pid = os.getpid()
    address = f"127.{1 + pid % 250}.{pid // 250 % 250}.{200 + next(_numbers)}"
    arguments = ["--address", address, "--model", model, "--speed", speed, "--side-port", "0"]
    mock = subprocess.Popen(
        [sys.executable, "-m", "hil_mock_robot", "ur", *arguments],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert mock.stdout is not None
    try:
        if not mock.stdout.readline().startswith("ready"):
            raise RobotError(
                "the mock UR controller does not come up",
                hint=f"see what it says: python -m hil_mock_robot ur --address {address}",
            )
        yield address, mock.pid
    finally:
        mock.terminate()
        mock.wait(20)
        mock.stdout.close()


def _cpu_of(pid: int) -> float:
    """CPU time of a process [s]; Linux."""
    told = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(told[11]) + int(told[12])) / os.sysconf("SC_CLK_TCK")
