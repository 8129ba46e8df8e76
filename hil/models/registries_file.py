"""File `RUNS/.registries`: the registries with models or probes of the runs in a folder.

A registry may be in any folder, and the run of a registered model must not be deleted. Therefore
each registry adds its path to a file in the folder of runs, one path per line, as JSON text. The
`.registries` file is append-only. If a registry was deleted permanently, an operator must remove
its line from the `.registries` file.
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
    """Add a registry to the `.registries` file of each folder of runs with a source of it.

    Folders of runs without write permission are skipped.

    Args:
        registry: Folder of the registry to add.
        sources: Run directories, or files and folders in run directories; other paths are ignored.

    Raises:
        RegistryError: The `.registries` file cannot be written.
    """
    line = json.dumps(str(registry.resolve())).encode() + b"\n"
    for file in {root / FILE for source in sources if (root := _runs_of(source))}:
        try:
            with file.open("ab+") as opened:
                opened.seek(0)
                if line not in opened.readlines():
                    opened.write(line)  # append mode: other processes may write lines
                    opened.flush()
                    os.fsync(opened.fileno())
        except OSError as error:
            if error.errno not in _NOT_OURS:
                raise RegistryError(
                    f"cannot write {file}: {error.strerror or error}",
                    hint="check that the folder is writable and that the disk has space",
                ) from error


def _runs_of(source: Path) -> Path | None:
    """Return the folder of runs `RUNS` of a source in `RUNS/DAY/ROBOT/RUN/…`, or None."""
    whole = source.resolve()
    run = next((one for one in (whole, *whole.parents) if (one / "start.json").is_file()), None)
    if run is None or len(run.parents) < 3:
        return None
    with contextlib.suppress(ValueError):
        date.fromisoformat(run.parents[1].name)
        return run.parents[2]
    return None


REGISTRY = Path("registry")
"""Path of the default registry, relative to the current folder or to the parent of a folder of
runs.
"""


def known_registries(runs: Path, named: Iterable[Path] = ()) -> list[Path]:
    """Return every registry that may contain models of the runs in a folder.

    The returned list contains all registries in `named`, in $HIL_REGISTRY and in the `.registries`
    file of the folder, whether they exist or not. The returned list also contains the default
    registries, if they exist.

    Raises:
        RegistryError: A registry in the `.registries` file does not exist, or the file cannot be
            read.
    """
    default = [place for place in (REGISTRY, runs.resolve().parent / REGISTRY) if place.exists()]
    variable = os.environ.get("HIL_REGISTRY")
    chosen = [*named, *([Path(variable)] if variable else [])]
    return list({one.resolve(): one for one in (*default, *chosen, *registries_of(runs))}.values())


def registries_of(runs: Path) -> list[Path]:
    """Return the registries in the `.registries` file of a folder of runs.

    Raises:
        RegistryError: One of the registries does not exist, or the file cannot be read.
    """
    file = runs / FILE
    try:
        lines = file.read_bytes().splitlines()
        registries = [Path(json.loads(line)) for line in lines if line.strip()]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, TypeError) as error:
        raise RegistryError(
            f"{file}, the list of registries with runs of this folder, cannot be read: {error}",
            hint="write one registry per line, in quotes; nothing is deleted until then",
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
        f"{file} names the registry {registry}, which does not exist or has no models",
        hint="restore it; or remove that line, and give its present folder with --registry",
    )
