"""Checks of this computer: Python and cores, disk and folders, devices and ports, clocks.

Each check yields its findings and raises no exception.
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
    """Yield findings about Python, hil, and the number of cores available to this process."""
    version = ".".join(map(str, sys.version_info[:3]))
    yield Finding("python", version, "ok" if sys.version_info >= LEAST_PYTHON else "bad")
    yield Finding("hil", importlib.metadata.version("hil"))
    yield Finding("cores", str(cores()))


def blas_threads() -> Iterator[Finding]:
    """Yield a finding about linear algebra threads per process: more than one per core is slow."""
    import threadpoolctl

    np.dot(np.eye(2), np.eye(2))  # numpy loads the BLAS library on first use
    pools = [pool for pool in threadpoolctl.threadpool_info() if pool["user_api"] == "blas"]
    threads = max((int(pool["num_threads"]) for pool in pools), default=1)
    text = f"{threads} per process, {cores()} cores"
    if threads > cores():
        text += "; more threads than cores wait for each other: export OMP_NUM_THREADS=1"
    yield Finding("blas threads", text, "note" if threads > cores() else "ok")


# Disk, folders and serial devices


LOW_DISK_BYTES = 2e9


def disk_space() -> Iterator[Finding]:
    """Yield a finding about the free space of the folder in which runs are stored by default."""
    free = shutil.disk_usage(Path.cwd()).free
    text = f"{free / 1e9:.1f} GB free here"
    yield Finding("disk", text, "ok" if free > LOW_DISK_BYTES else "bad")


def folders() -> Iterator[Finding]:
    """Yield whether the folders of runs, leases, models and cached trajectories are writable.

    The check of the folders creates no folder or file.
    """
    runs = Path(os.environ.get("HIL_RUNS") or "runs")
    registry = Path(os.environ.get("HIL_REGISTRY") or "registry")
    cache = user_cache().folder
    yield _writable("folder", Path(), "bad", "change to a writable folder")
    yield _writable("runs", runs, "bad", "choose a different folder: --runs DIR or $HIL_RUNS")
    leases = leases_folder()
    if leases.is_dir() and not os.environ.get("HIL_LEASES") and not _is_own(leases):
        text = f"{leases} belongs to another user; choose a different folder: $HIL_LEASES"
        yield Finding("leases", text, "bad")
    else:
        yield _writable(
            "leases", leases, "bad", "choose a different folder for leases: $HIL_LEASES"
        )
    remedy = "choose a different folder: --registry DIR or $HIL_REGISTRY"
    yield _writable("registry", registry, "note", remedy)
    if cache is not None:
        yield _writable(
            "cache", cache, "note", "choose a different folder: $HIL_CACHE, or HIL_CACHE=off"
        )


def _is_own(folder: Path) -> bool:
    with contextlib.suppress(OSError):
        return folder.lstat().st_uid == os.getuid()
    return False


def _writable(what: str, folder: Path, level: str, remedy: str) -> Finding:
    """Return whether a folder is writable, or can be created if it does not exist."""
    above = folder.absolute()
    while not above.exists() and above != above.parent:
        above = above.parent
    if not (above.is_dir() and os.access(above, os.W_OK | os.X_OK)):
        reason = "is not writable" if above.is_dir() else "is not a folder"
        return Finding(what, f"{above} {reason}; {remedy}", level)
    exists = folder.absolute() == above
    return Finding(what, "writable" if exists else f"{folder} can be created")


SERIAL = ("ttyUSB*", "ttyACM*")
"""Name patterns of serial adapters in /dev, including CAN adapters; users of these adapters need
the group `dialout`."""


def serial_adapters(devices: Path = Path("/dev")) -> Iterator[Finding]:
    """Yield whether the serial adapters can be opened; nothing if there are no adapters.

    Args:
        devices: Folder in which the operating system lists the devices.
    """
    adapters = sorted(path for pattern in SERIAL for path in devices.glob(pattern))
    closed = [path.name for path in adapters if not os.access(path, os.R_OK | os.W_OK)]
    if closed:
        remedy = "sudo usermod -aG dialout $USER, then log in again"
        yield Finding("serial", f"{', '.join(closed)} cannot be opened: {remedy}", "note")
    elif adapters:
        yield Finding("serial", f"{', '.join(path.name for path in adapters)} can be opened")


# TCP ports


PORTS = {
    "dashboard": ((8350,), "hil serve uses one of the next ports"),
    "live view": ((8765,), "hil run --live uses one of the next ports"),
    "mock ur": ((29999, 30001, 30002, 30003, 30004), "hil mock ur cannot start"),
    "mock plc": ((48898,), "hil mock plc cannot start"),
}
"""Ports of each service, and the consequence if one of the ports is in use."""


def ports() -> Iterator[Finding]:
    """Yield whether the ports of `hil` are in use on the loopback interface.

    A port may be in use by a mock that is running.
    """
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
    """Yield a finding about the resolution of the clock used for motion and recordings."""
    finest_s = time.get_clock_info("monotonic").resolution
    coarse = finest_s > COARSE_S
    text = f"monotonic, {finest_s * 1e9:.0f} ns"
    if coarse:
        text += ": too coarse for the cycle of a driver"
    yield Finding("clock", text, "note" if coarse else "ok")


FIRST_YEAR = 2025
"""Earliest plausible year of the computer's clock; the program did not exist earlier."""

DAY_S = 86400.0


def date() -> Iterator[Finding]:
    """Yield whether the date is plausible, because run names and schedules depend on the date."""
    now = time.time()
    text = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(now))
    remedy = "set the clock: names of runs and schedules depend on it"
    if time.gmtime(now).tm_year < FIRST_YEAR:
        yield Finding("date", f"{text} is implausible; {remedy}", "bad")
    elif now + DAY_S < Path(__file__).stat().st_mtime:
        yield Finding("date", f"{text} is before hil was installed; {remedy}", "note")
    else:
        yield Finding("date", text)


def time_service() -> Iterator[Finding]:
    """Yield whether a service such as NTP synchronizes the computer's clock."""
    synchronised = _is_synchronised()
    if synchronised is None:
        yield Finding("time service", "unknown on this system", "note")
    elif synchronised:
        yield Finding("time service", "the clock is synchronised")
    else:
        remedy = "timedatectl set-ntp true, or chrony; time stamps of recordings depend on it"
        yield Finding("time service", f"the clock is not synchronised: {remedy}", "note")


_TIME_ERROR = 5
"""Return value of adjtimex(2) for a clock that is not synchronized."""


def _is_synchronised() -> bool | None:
    """Return whether the Linux kernel reports a synchronized clock; None on other systems."""
    if not sys.platform.startswith("linux"):
        return None
    try:
        adjtimex = ctypes.CDLL(None, use_errno=True).adjtimex
    except (AttributeError, OSError):
        return None
    # struct timex with modes = 0 changes nothing. Its size is 208 bytes on 64-bit Linux.
    state = adjtimex(ctypes.create_string_buffer(512))
    if state < 0:
        return None
    return int(state) != _TIME_ERROR or os.path.exists("/run/systemd/timesync/synchronized")


def real_time() -> Iterator[Finding]:
    """Yield whether the system permits real-time scheduling, needed by drivers with a bus cycle."""
    try:
        before = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        os.sched_setscheduler(0, *before)
    except (AttributeError, OSError):
        text = "not permitted: cycles of a CAN driver may be late while the computer is busy; "
        yield Finding("real-time", f"{text}LimitRTPRIO=80, or ulimit -r 80, permits it", "note")
        return
    yield Finding("real-time", "SCHED_FIFO is permitted")


# CAN interfaces of the kernel, which most adapters use


BITRATE = 1_000_000
"""Default bit rate of the drives supported by hil [bit/s]."""


def socketcan(network: Path = NETWORK) -> Iterator[Finding]:
    """Yield whether the kernel supports CAN, and which CAN interfaces are up.

    Args:
        network: Folder in which the kernel lists its network interfaces.
    """
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (AttributeError, OSError):
        text = "no SocketCAN, because this kernel has no CAN (AF_CAN); mock drives and adapters"
        yield Finding("can", f"{text} with their own python-can driver work", "note")
        return
    names = can_interfaces(network)
    down = [name for name in names if not is_up(name, network)]
    if down:
        text = f"SocketCAN; {', '.join(down)} is down: {up_command(down[0], BITRATE)}"
        yield Finding("can", text, "note")
    else:
        yield Finding("can", f"SocketCAN; interfaces: {', '.join(names) or 'none'}")
