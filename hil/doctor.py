"""What `hil doctor` looks at; nothing here may raise."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import shutil
import socket
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from hil import plugins
from hil.errors import HilError

EXTRAS = {
    "mock": ("mujoco", "numba"),
    "ur": ("rtde_control",),
    "can": ("can", "canopen"),
    "learn": ("torch",),
    "fleet": ("distributed",),
    "bags": ("rosbags",),
    "live": ("foxglove",),
    "web": ("starlette", "uvicorn", "sse_starlette"),
}
LOW_DISK_BYTES = 2e9


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        what: The thing.
        finding: What was found, and how to mend it when bad.
        level: `ok`, `note` or `bad`.
    """

    what: str
    finding: str
    level: str = "ok"

    @property
    def bad(self) -> bool:
        """True when `hil` cannot do its main job."""
        return self.level == "bad"

    @property
    def mark(self) -> str:
        """A word, so that nothing depends on colour."""
        return {"ok": "ok", "note": "note", "bad": "BAD"}[self.level]

    def to_dict(self) -> dict[str, str]:
        """JSON form."""
        return {"what": self.what, "finding": self.finding, "level": self.level}


def examine(station: Path | None = None) -> list[Finding]:
    """Look at everything.

    Args:
        station: Also check this station file.
    """
    checks: list[Callable[[], Iterator[Finding]]] = [
        _python, _extras, _torch, _plugins, _disk, _clock, _real_time, _can,
    ]  # fmt: skip
    findings = [finding for check in checks for finding in check()]
    return findings + (list(_station(station)) if station else [])


def _python() -> Iterator[Finding]:
    version = ".".join(map(str, sys.version_info[:3]))
    yield Finding("python", version, "ok" if sys.version_info >= (3, 11) else "bad")
    yield Finding("hil", importlib.metadata.version("hil"))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    yield Finding("cores", str(cores))


def _extras() -> Iterator[Finding]:
    for extra, modules in EXTRAS.items():
        missing = [m for m in modules if importlib.util.find_spec(m) is None]
        if missing:
            text = f'{", ".join(missing)} missing; for it: pip install "hil[{extra}]"'
            yield Finding(f"extra {extra}", text, "note")
        else:
            yield Finding(f"extra {extra}", "installed")


def _torch() -> Iterator[Finding]:
    """Which torch there is, and what networks are trained on by `device: auto`."""
    try:
        version = importlib.metadata.version("torch")
    except importlib.metadata.PackageNotFoundError:
        return  # the extra `learn` is missing, which has been told
    if version.endswith("+cpu"):
        yield Finding("torch", f"{version}: networks are trained on the CPU")
        return
    try:
        import torch

        names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    except Exception as error:  # a driver that does not fit, a library that is missing, …
        yield Finding("torch", f"{version} cannot be used: {error}", "note")
        return
    yield Finding("torch", f"{version}: networks are trained on {names[0] if names else 'the CPU'}")


def _plugins() -> Iterator[Finding]:
    broken = [row for row in plugins.describe_all() if row.error]
    for row in broken:
        yield Finding(f"plug-in {row.name}", row.error, "note")
    if not broken:
        yield Finding("plug-ins", "all load")


def _disk() -> Iterator[Finding]:
    free = shutil.disk_usage(Path.cwd()).free
    text = f"{free / 1e9:.1f} GB free here"
    yield Finding("disk", text, "ok" if free > LOW_DISK_BYTES else "bad")
    writable = os.access(Path.cwd(), os.W_OK)
    yield Finding("folder", "writable" if writable else "not writable", "ok" if writable else "bad")


def _clock() -> Iterator[Finding]:
    resolution = time.get_clock_info("monotonic").resolution
    yield Finding("clock", f"monotonic, {resolution * 1e9:.0f} ns")


def _real_time() -> Iterator[Finding]:
    """Whether a driver that owns the clock of a bus may ask to be woken in time."""
    try:
        before = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        os.sched_setscheduler(0, *before)
    except (AttributeError, OSError):
        text = "not permitted: cycles of a CAN driver may come late while the computer is busy; "
        yield Finding("real-time", f"{text}LimitRTPRIO=80, or ulimit -r 80, permits it", "note")
        return
    yield Finding("real-time", "SCHED_FIFO is permitted")


def _can() -> Iterator[Finding]:
    """Whether there are CAN interfaces of the kernel, as most adapters are."""
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW):
            names = [name for _, name in socket.if_nameindex() if "can" in name]
    except (AttributeError, OSError):
        text = "this kernel has no CAN (AF_CAN): mock drives and adapters with a python-can driver"
        yield Finding("can", f"{text} of their own work, SocketCAN does not", "note")
        return
    yield Finding("can", f"SocketCAN; interfaces: {', '.join(names) or 'none is up'}")


def _station(path: Path) -> Iterator[Finding]:
    from hil.spec.load import load_station

    try:
        station = load_station(path)
    except HilError as error:
        yield Finding("station", str(error), "bad")
        return
    named = ", ".join(station.robots)
    yield Finding("station", f"{path}: the file is valid; its robots ({named}) were not asked")
