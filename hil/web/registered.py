"""What the registry holds, read version by version: one that is damaged spoils no page."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from urllib.parse import quote

from hil.errors import HilError
from hil.identify.model_folder import MODEL_FILE
from hil.registry.registry import Registry
from hil.registry.version import ModelVersion, numbers_in, read_version
from hil.web.settings import Settings


def model_address(name: str, number: int = 0) -> str:
    """Path of the page of a name, or of one of its versions."""
    return f"/models/{quote(name)}" + (f"/v{number}" if number else "")


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


def run_named(folder: str, settings: Settings) -> Path | None:
    """A run that a document names, where it is one that is served; it may have been moved."""
    if not folder:
        return None
    root, path = settings.runs.resolve(), Path(folder)
    here = root.joinpath(*path.parts[-3:])
    for one in (path, here):
        try:
            if one.is_dir() and one.resolve().is_relative_to(root):
                return one.resolve()
        except OSError:
            continue
    return None
