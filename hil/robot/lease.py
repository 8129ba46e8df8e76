"""Leases: a lease gives one process exclusive access to a robot until the process exits.

A lease is a file for one robot in the folder `$HIL_LEASES`. The default folder of leases is a
folder of the user in `/tmp`, which, unlike `$XDG_RUNTIME_DIR`, is the same in a session, under cron
and after logging out. The lease file is locked while a process uses the robot, contains the name of
the holder, and is touched every second (`hil.core.lock_file`).
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shlex
import stat
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from hil.core import (
    Holder,
    LockFile,
    RobotConnectionError,
    SpecError,
    hold,
    holder_of,
)
from hil.robot.protocol import HasResource, Robot

SUFFIX = ".lease"
TRY_EVERY_S = 0.2


def resource_of(robot: Robot, *, name: str, driver: str, station: str) -> str:
    """Return the name of the exclusive resource of a robot.

    The name is empty for a robot that only this process can access.

    Args:
        robot: Robot whose resource is named; it need not be connected.
        name: Name of the robot in its station.
        driver: Name of the driver of the robot.
        station: Path of the station file, or name of the station.

    Raises:
        SpecError: `station` is a file name, but the file does not exist.
    """
    if isinstance(robot, HasResource):
        return robot.resource
    if robot.capabilities.clock == "virtual":
        return ""
    return f"{driver}:{name}@{_same_everywhere(station)}"


def _same_everywhere(station: str) -> str:
    """Return the absolute path of a station file, independent of the working directory."""
    file = Path(station)
    if file.is_file() or file.is_absolute():
        return str(file.resolve())
    if file.suffix in (".yaml", ".yml"):
        # The bare name would denote a different station than in the folder of the file.
        raise SpecError(
            f"there is no station file {station} in {Path.cwd()}",
            hint="pass its full path, such as Path(__file__).with_name('bench.yaml')",
        )
    return station


def leases_folder() -> Path:
    """Return the folder of leases: `$HIL_LEASES`, or `hil-<user id>` in the temporary folder."""
    if named := os.environ.get("HIL_LEASES"):
        return Path(named)
    # Not $TMPDIR, because processes that share leases possibly have different values of it.
    system = Path("/tmp") if os.name == "posix" else Path(tempfile.gettempdir())  # noqa: S108
    return system / f"hil-{os.getuid()}"


def lease_path(resource: str) -> Path:
    """Return the lease file of a resource.

    The file name is readable and unique for every resource.
    """
    readable = re.sub(r"[^a-z0-9.]+", "-", resource.lower()).strip("-.")[:48]
    digest = hashlib.sha256(resource.encode()).hexdigest()[:8]
    return leases_folder() / f"{readable}-{digest}{SUFFIX}"


@dataclass(frozen=True, slots=True)
class Lease:
    """Lease that this process holds: exclusive access to one robot.

    Attributes:
        resource: Name of the exclusive resource; empty for a robot that needs no lease.
        file: The locked lease file.
    """

    resource: str
    file: LockFile | None = None

    def note_run(self, run: Path) -> None:
        """Write the run that uses the robot into the lease file, as information for others.

        Other processes report this run when the robot is in use.
        """
        if self.file is not None:
            # the note is only informative, so a failure is ignored
            with contextlib.suppress(OSError):
                self.file.update(run=str(run.resolve()))

    def release(self) -> None:
        """Release the lease. Idempotent."""
        if self.file is not None:
            self.file.release()

    def __enter__(self) -> Lease:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.release()


def leased(
    robot: Robot,
    *,
    name: str,
    driver: str,
    station: str,
    wait_s: float = 0.0,
    tell: Callable[[str], object] = lambda text: None,
) -> Lease:
    """Acquire the lease of a robot; the returned context manager releases the lease.

    Args:
        robot: Robot to be leased; it need not be connected.
        name: Name of the robot in its station.
        driver: Name of the driver of the robot.
        station: Path of the station file, or name of the station.
        wait_s: Maximum time to wait until the present holder releases the robot [s].
        tell: Callback that receives one message about the present holder of the lease.

    Raises:
        RobotConnectionError: A different process uses the robot, or leases cannot be stored.
        SpecError: The resource of the robot cannot be named, see `resource_of`.
    """
    resource = resource_of(robot, name=name, driver=driver, station=station)
    if not resource:
        return Lease("")
    about = {"resource": resource, "robot": name, "driver": driver, "station": station, "run": ""}
    deadline, notified = time.monotonic() + wait_s, False
    while isinstance(taken := _take(resource, about), Holder):
        held = f"robot {name} is held by {taken}"
        if time.monotonic() >= deadline:
            waited = f", still after {wait_s:g} s" if wait_s else ""
            raise RobotConnectionError(held + waited, hint=_hint_for_held_robot(station, wait_s))
        if not notified:
            tell(f"{held}; waiting up to {wait_s:g} s")
            notified = True
        time.sleep(TRY_EVERY_S)
    return Lease(resource, taken)


def _hint_for_held_robot(station: str, waited_s: float) -> str:
    """Return the hint for a robot that a different process uses.

    The command in the hint, `hil robots`, lists the built-in bench if no station file is passed.
    """
    file = f" --station {shlex.quote(station)}" if Path(station).is_file() else ""
    wait = "" if waited_s else "; wait until it is released: hil run … --wait 600"
    return f"list the robots and their holders: hil robots{file}{wait}"


def held_leases() -> list[Holder]:
    """Return the holders of all leases that are in the same folder."""
    try:
        files = sorted(leases_folder().glob(f"*{SUFFIX}"))
    except OSError:
        return []
    return [holder for file in files if (holder := holder_of(file)) is not None]


def lease_holder(resource: str) -> Holder | None:
    """Return the holder of the lease of a resource; None if the resource is free."""
    return holder_of(lease_path(resource))


def _take(resource: str, about: dict[str, str]) -> LockFile | Holder:
    try:
        _make_folder()
        return hold(lease_path(resource), about, shared=_is_shared())
    except OSError as error:
        raise RobotConnectionError(
            f"cannot store a lease in {leases_folder()}: {error.strerror or error}",
            hint="choose a writable folder: HIL_LEASES=FOLDER",
        ) from error


def _is_shared() -> bool:
    return bool(os.environ.get("HIL_LEASES"))


def _make_folder() -> None:
    folder = leases_folder()
    if _is_shared():
        folder.mkdir(parents=True, exist_ok=True)
        return
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    found = folder.lstat()
    # Every user can create a folder of this name, so the owner must be checked.
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
        raise PermissionError("it belongs to a different user")
    folder.chmod(0o700)
