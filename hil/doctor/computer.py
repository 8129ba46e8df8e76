"""Checks of this computer: Python and cores, disk and folders, devices and ports, clocks.

Each check yields its findings and never raises.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.metadata
import os
import shutil
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hil.can import NETWORK, can_interfaces, is_up, up_command
from hil.core import cores
from hil.doctor.finding import Finding
from hil.excitation import user_cache
from hil.robot import leases_folder

# Python and processor


LEAST_PYTHON = (3, 11)


def python() -> Iterator[Finding]:
    """Yield the versions of Python and hil, and how many cores this process may use."""
    version = ".".join(map(str, sys.version_info[:3]))
    yield Finding("python", version, "ok" if sys.version_info >= LEAST_PYTHON else "bad")
    yield Finding("hil", importlib.metadata.version("hil"))
    yield Finding("cores", str(cores()))


def blas_threads() -> Iterator[Finding]:
    """Yield the threads that linear algebra starts in every process: more than cores are slow."""
    import threadpoolctl

    np.dot(np.eye(2), np.eye(2))  # the library is loaded when it is used
    pools = [pool for pool in threadpoolctl.threadpool_info() if pool["user_api"] == "blas"]
    threads = max((int(pool["num_threads"]) for pool in pools), default=1)
    text = f"{threads} per process, {cores()} cores"
    if threads > cores():
        text += "; more threads than cores wait for each other: export OMP_NUM_THREADS=1"
    yield Finding("blas threads", text, "note" if threads > cores() else "ok")


# Disk, folders and serial devices


LOW_DISK_BYTES = 2e9


def disk_space() -> Iterator[Finding]:
    """Yield the free space of the folder where runs are stored by default."""
    free = shutil.disk_usage(Path.cwd()).free
    text = f"{free / 1e9:.1f} GB free here"
    yield Finding("disk", text, "ok" if free > LOW_DISK_BYTES else "bad")


def folders() -> Iterator[Finding]:
    """Yield whether runs, leases, models and cached trajectories can be written.

    Nothing is created.
    """
    runs = Path(os.environ.get("HIL_RUNS") or "runs")
    registry = Path(os.environ.get("HIL_REGISTRY") or "registry")
    cache = user_cache().folder
    yield _writable("folder", Path(), "bad", "go to one of your own")
    yield _writable("runs", runs, "bad", "name another: --runs DIR or $HIL_RUNS")
    leases = leases_folder()
    if leases.is_dir() and not os.environ.get("HIL_LEASES") and not _is_own(leases):
        text = f"{leases} belongs to another user; name another folder: $HIL_LEASES"
        yield Finding("leases", text, "bad")
    else:
        yield _writable("leases", leases, "bad", "name another for leases: $HIL_LEASES")
    yield _writable("registry", registry, "note", "name another: --registry DIR or $HIL_REGISTRY")
    if cache is not None:
        yield _writable("cache", cache, "note", "name another: $HIL_CACHE, or HIL_CACHE=off")


def _is_own(folder: Path) -> bool:
    with contextlib.suppress(OSError):
        return folder.lstat().st_uid == os.getuid()
    return False


def _writable(what: str, folder: Path, level: str, remedy: str) -> Finding:
    """Return whether a folder can be written to, or could be created."""
    above = folder.absolute()
    while not above.exists() and above != above.parent:
        above = above.parent
    if not (above.is_dir() and os.access(above, os.W_OK | os.X_OK)):
        reason = "is not writable" if above.is_dir() else "is no folder"
        return Finding(what, f"{above} {reason}; {remedy}", level)
    exists = folder.absolute() == above
    return Finding(what, "writable" if exists else f"{folder} can be made")


SERIAL = ("ttyUSB*", "ttyACM*")
"""Adapters below /dev that need the group `dialout`; CAN adapters by serial line are among them."""


def serial_adapters(devices: Path = Path("/dev")) -> Iterator[Finding]:
    """Yield serial adapters and whether they may be opened; nothing if there is none.

    Args:
        devices: Folder of the devices.
    """
    adapters = sorted(path for pattern in SERIAL for path in devices.glob(pattern))
    closed = [path.name for path in adapters if not os.access(path, os.R_OK | os.W_OK)]
    if closed:
        remedy = "sudo usermod -aG dialout $USER, then log in again"
        yield Finding("serial", f"{', '.join(closed)} may not be opened: {remedy}", "note")
    elif adapters:
        yield Finding("serial", f"{', '.join(path.name for path in adapters)} may be opened")


# TCP ports


PORTS = {
    "dashboard": ((8350,), "hil serve takes one of the next"),
    "live view": ((8765,), "hil run --live takes one of the next"),
    "mock ur": ((29999, 30001, 30002, 30003, 30004), "hil mock ur cannot start beside it"),
    "mock plc": ((48898,), "hil mock plc cannot start beside it"),
}
"""What listens on which ports, and what follows when one is in use."""


def ports() -> Iterator[Finding]:
    """Yield which ports of `hil` are in use on loopback; a running mock of ours is one user."""
    for what, (numbers, follows) in PORTS.items():
        taken = [str(number) for number in numbers if _is_taken(number)]
        if taken:
            yield Finding(f"ports {what}", f"{', '.join(taken)} in use: {follows}", "note")
        else:
            yield Finding(f"ports {what}", f"{', '.join(map(str, numbers))} free on loopback")


def _is_taken(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as line:
        line.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            line.bind(("127.0.0.1", port))
        except OSError:
            return True
    return False


# Clocks and scheduling


COARSE_S = 1e-3


def clock_resolution() -> Iterator[Finding]:
    """Yield the resolution of the clock that motion and recordings go by."""
    finest_s = time.get_clock_info("monotonic").resolution
    coarse = finest_s > COARSE_S
    text = f"monotonic, {finest_s * 1e9:.0f} ns"
    if coarse:
        text += ": too coarse to keep a driver's cycle by"
    yield Finding("clock", text, "note" if coarse else "ok")


FIRST_YEAR = 2025
"""The program is not older."""

DAY_S = 86400.0


def date() -> Iterator[Finding]:
    """Yield whether the date is plausible: runs are named by it, and schedules go by it."""
    now = time.time()
    text = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(now))
    remedy = "set the clock: runs are named by it, and schedules go by it"
    if time.gmtime(now).tm_year < FIRST_YEAR:
        yield Finding("date", f"{text} cannot be; {remedy}", "bad")
    elif now + DAY_S < Path(__file__).stat().st_mtime:
        yield Finding("date", f"{text} is before hil was installed; {remedy}", "note")
    else:
        yield Finding("date", text)


def time_service() -> Iterator[Finding]:
    """Yield whether a service such as NTP synchronises the clock."""
    synchronised = _is_synchronised()
    if synchronised is None:
        yield Finding("time service", "cannot be told on this system", "note")
    elif synchronised:
        yield Finding("time service", "the clock is synchronised")
    else:
        remedy = "timedatectl set-ntp true, or chrony, has it kept; recordings tell time by it"
        yield Finding("time service", f"the clock is not synchronised: {remedy}", "note")


_TIME_ERROR = 5
"""What adjtimex(2) returns for a clock that is not synchronised."""


def _is_synchronised() -> bool | None:
    """Return what the Linux kernel says; None elsewhere."""
    if not sys.platform.startswith("linux"):
        return None
    try:
        adjtimex = ctypes.CDLL(None, use_errno=True).adjtimex
    except (AttributeError, OSError):
        return None
    # struct timex with modes = 0: nothing is set. It has 208 bytes on 64-bit Linux.
    state = adjtimex(ctypes.create_string_buffer(512))
    if state < 0:
        return None
    return int(state) != _TIME_ERROR or os.path.exists("/run/systemd/timesync/synchronized")


def real_time() -> Iterator[Finding]:
    """Yield whether a driver that runs the cycle of a bus may ask for real-time scheduling."""
    try:
        before = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        os.sched_setscheduler(0, *before)
    except (AttributeError, OSError):
        text = "not permitted: cycles of a CAN driver may come late while the computer is busy; "
        yield Finding("real-time", f"{text}LimitRTPRIO=80, or ulimit -r 80, permits it", "note")
        return
    yield Finding("real-time", "SCHED_FIFO is permitted")


# CAN interfaces of the kernel, as most adapters are


BITRATE = 1_000_000
"""Of the drives that hil knows, unless a station says otherwise [bit/s]."""


def socketcan(network: Path = NETWORK) -> Iterator[Finding]:
    """Yield whether the kernel has CAN at all, and which interfaces are up.

    Args:
        network: Where the kernel lists its interfaces.
    """
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (AttributeError, OSError):
        text = "this kernel has no CAN (AF_CAN): mock drives and adapters with a python-can driver"
        yield Finding("can", f"{text} of their own work, SocketCAN does not", "note")
        return
    names = can_interfaces(network)
    down = [name for name in names if not is_up(name, network)]
    if down:
        text = f"SocketCAN; {', '.join(down)} is down: {up_command(down[0], BITRATE)}"
        yield Finding("can", text, "note")
    else:
        yield Finding("can", f"SocketCAN; interfaces: {', '.join(names) or 'none'}")
