"""What the registry holds, read version by version: one that is damaged spoils no page."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

from hil.core import HilError, quoted, read_json
from hil.dashboard.places import address_of
from hil.dashboard.settings import Settings
from hil.estimators import MODEL_FILE
from hil.models import ModelVersion, Registry, numbers_in, read_version


def model_address(name: str, number: int = 0) -> str:
    """Path of the page of a name, or of one of its versions."""
    return f"/models/{quoted(name)}" + (f"/v{number}" if number else "")


def versions_of(registry: Registry, name: str, problems: list[str]) -> list[ModelVersion]:
    """Versions of a name, oldest first; those that cannot be read are named in `problems`."""
    home, found = registry.root / name, []
    for number in numbers_in(home):
        try:
            found.append(read_version(home, number))
        except HilError as error:
            problems.append(error.message)
    return found


def registered_models(settings: Settings) -> dict[str, list[dict[str, Any]]]:
    """SHA-256 of a model's document → the versions it was registered as."""
    registry, found = Registry(settings.registry), dict[str, list[dict[str, Any]]]()
    for name in registry.names():
        for version in versions_of(registry, name, []):
            digest = str(version.files.get(MODEL_FILE, ""))
            address = model_address(name, version.number)
            told = {"text": f"{name} {version.label}", "address": address}
            found.setdefault(digest, []).append(told)
    return found


def run_named(folder: str, settings: Settings, uid: str = "") -> Path | None:
    """A run that a document names, where it is served here; folders of runs may have been moved.

    Args:
        folder: Where it was then.
        settings: What is served.
        uid: Identity of the run; empty where the document does not say.
    """
    root, path = settings.runs.resolve(), Path(folder)
    if not folder:
        return None
    with contextlib.suppress(OSError, ValueError):
        if path.is_dir() and path.resolve().is_relative_to(root):
            return path.resolve()
    if not uid and path.parts[-4:-3] != (root.name,):
        return None
    below = range(1, len(path.parts)) if uid else (len(path.parts) - 3,)
    for first in below:
        with contextlib.suppress(HilError, OSError, ValueError):
            here = root.joinpath(*path.parts[first:])
            told = read_json(here / "start.json").get("uid")
            if told == uid or not uid:
                return here
    return None


def run_link(folder: str, settings: Settings, uid: str = "") -> dict[str, str]:
    """`text` and `address` of a run that a document names; no address where it is not here."""
    run = run_named(folder, settings, uid)
    address = ""
    with contextlib.suppress(ValueError):
        address = address_of(run, settings) if run else ""
    return {"text": Path(folder).name, "address": address}
