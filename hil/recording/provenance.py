"""Where a run comes from: code, packages, machine, person. Never needs a network, never hangs."""

from __future__ import annotations

import getpass
import importlib.metadata
import os
import platform
import re
import uuid
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hil.recording.git import git_state, is_tracked

STARTED_ID = "HIL_STARTED_ID"
"""In the environment of a process that somebody without a console has started: names it."""

_PACKAGE = Path(__file__).resolve().parent.parent


def collect_provenance(spec_folder: Path | None = None) -> dict[str, Any]:
    """What `start.json` says about the circumstances.

    `git` is the revision of hil itself where it runs from a checkout (its version is among
    `packages`), `spec_git` that of the repository in which the spec is kept.

    Args:
        spec_folder: Where the spec is.
    """
    return {
        "uid": str(uuid.uuid4()),
        "started": utc_now(),
        "operator": operator(),
        "host": platform.node(),
        "pid": os.getpid(),
        **started_as(),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "packages": package_versions(),
        "git": source_revision(),
        "spec_git": git_state(spec_folder) if spec_folder else None,
    }


def started_as() -> dict[str, str]:
    """The name under which this process was started; empty where a person did that."""
    name = os.environ.get(STARTED_ID, "")
    return {"started_as": name} if name else {}


def utc_now() -> str:
    """The present moment in UTC, ISO 8601 with milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def package_versions() -> dict[str, str]:
    """Versions of `hil` and of the packages it may use, as far as they are installed."""
    try:
        requirements = importlib.metadata.requires("hil") or []
    except importlib.metadata.PackageNotFoundError:
        requirements = []
    names = {name[0] for line in requirements if (name := re.match(r"[\w.-]+", line))}
    versions = {name: _version(name) for name in sorted({"hil"} | names)}
    return {name: version for name, version in versions.items() if version}


def source_revision() -> dict[str, Any] | None:
    """`git_state` of the checkout hil runs from, None when it is installed from a wheel."""
    # A virtual environment often lies in somebody else's repository: that one must track hil.
    return git_state(_PACKAGE) if is_tracked(_PACKAGE / "__init__.py") else None


def operator() -> str:
    """Who is at work: the user of this process."""
    try:
        return getpass.getuser()
    except (KeyError, OSError, ImportError):
        return "unknown"


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
