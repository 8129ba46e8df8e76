"""The file `RUNS/.registries`: which registries have models or probes of the runs in a folder.

A registry may be anywhere, and a run that a model came from must not be deleted because nothing
named the registry. So a registry notes itself in the folder of runs: a path a line, as JSON text.
The file only grows; a line is taken out by hand when its registry is gone for good.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
from collections.abc import Iterable
from datetime import date
from pathlib import Path

from hil.core import RegistryError

FILE = ".registries"

_NOT_OURS = (errno.EROFS, errno.EACCES, errno.EPERM)


def note_registry(registry: Path, sources: Iterable[Path]) -> None:
    """Note a registry in the folders of runs that its sources lie in.

    A folder of runs that may not be written to is left as it is.

    Args:
        registry: Folder of the models.
        sources: Run directories, and files and folders in them; others are left out.

    Raises:
        RegistryError: It cannot be noted.
    """
    line = json.dumps(str(registry.resolve())).encode() + b"\n"
    for file in {root / FILE for source in sources if (root := _runs_of(source))}:
        try:
            with file.open("ab+") as opened:
                opened.seek(0)
                if line not in opened.readlines():
                    opened.write(line)  # appended, also if another process has added lines
                    opened.flush()
                    os.fsync(opened.fileno())
        except OSError as error:
            if error.errno not in _NOT_OURS:
                raise RegistryError(
                    f"cannot write {file}: {error.strerror or error}",
                    hint="see whether the folder may be written to and the disk has room",
                ) from error


def _runs_of(source: Path) -> Path | None:
    """Return the folder of runs that a source is in, as `RUNS/DAY/ROBOT/RUN/…`; else None."""
    whole = source.resolve()
    run = next((one for one in (whole, *whole.parents) if (one / "start.json").is_file()), None)
    if run is None or len(run.parents) < 3:
        return None
    with contextlib.suppress(ValueError):
        date.fromisoformat(run.parents[1].name)
        return run.parents[2]
    return None


REGISTRY = Path("registry")
"""Where the registry is by default: here, and beside a folder of runs."""


def known_registries(runs: Path, named: Iterable[Path] = ()) -> list[Path]:
    """Return every registry that may have models of runs of a folder.

    These are the named ones, $HIL_REGISTRY and those noted in the folder, whether they are there or
    not, and the default ones that are there.

    Raises:
        RegistryError: One that is noted is not there, or the note cannot be read.
    """
    default = [place for place in (REGISTRY, runs.resolve().parent / REGISTRY) if place.exists()]
    variable = os.environ.get("HIL_REGISTRY")
    chosen = [*named, *([Path(variable)] if variable else [])]
    return list({one.resolve(): one for one in (*default, *chosen, *registries_of(runs))}.values())


def registries_of(runs: Path) -> list[Path]:
    """Return the registries that are noted in a folder of runs.

    Raises:
        RegistryError: One of them is not there, or the file cannot be read.
    """
    file = runs / FILE
    try:
        lines = file.read_bytes().splitlines()
        registries = [Path(json.loads(line)) for line in lines if line.strip()]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, TypeError) as error:
        raise RegistryError(
            f"{file} does not say which registries know runs of this folder: {error}",
            hint="a registry a line, in quotes; nothing is deleted before",
        ) from error
    for registry in registries:
        _require_models(registry, file)
    return registries


def _require_models(registry: Path, file: Path) -> None:
    """Raise if a registry is missing or empty: an unmounted disk leaves an empty folder."""
    with contextlib.suppress(OSError):
        if any(registry.glob("*/v[0-9]*")):
            return
    raise RegistryError(
        f"{file} names the registry {registry}, which is not there or has no models",
        hint="bring it back; or take that line out, and give where it is now with --registry",
    )
