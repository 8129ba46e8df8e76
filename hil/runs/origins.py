"""Which runs registered models came from: what no policy may take away.

A version's facts name its run, its training sources and the digests of their recordings. Whatever
of them fits a run keeps it (`Origins.why`); where they say too little, every run that may be meant
is kept. A run that was renamed leaves its models with a name that leads nowhere: the rows that a
model remembers of its training data (`hil.data.Sketch`) still find it (`why_by_rows`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any

from hil.core import DataError, HilError, RegistryError, read_json, sha256_of
from hil.data import Sketch
from hil.estimators import load_model_file
from hil.importers import load_source
from hil.models import ModelVersion, Registry, probes_of
from hil.recording import PARTIAL_SUFFIX, RunDirectory


@dataclass(frozen=True, slots=True)
class Vague:
    """A version that was fitted to recordings of which only the name is known, or nothing."""

    names: frozenset[str]
    serial: str
    registered: str
    why: str


@dataclass(frozen=True, slots=True)
class Lost:
    """A version that was fitted to a run of this name, which may be called otherwise by now."""

    name: str
    model: Path
    why: str


_BELOW = 3
"""Parts of a run's path that stay when all runs are moved together: day, robot, directory."""


@dataclass(frozen=True, slots=True)
class Origins:
    """What models and probes came from, each with the reason for keeping it.

    Attributes:
        uids: Of runs, and digests of recordings that probes were.
        folders: Last parts of runs' paths.
        names: Of run directories.
        digests: SHA-256 of recordings.
        vague: What may be any of several.
        by_name: Versions of which of some runs nothing but the name is known.
    """

    uids: dict[str, str] = field(default_factory=dict)
    folders: dict[tuple[str, ...], str] = field(default_factory=dict)
    names: dict[str, str] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)
    vague: list[Vague] = field(default_factory=list)
    by_name: list[Lost] = field(default_factory=list)

    def why(self, run: Path, facts: Mapping[str, Any]) -> str:
        """Why a run has to stay; empty where no model came from it.

        Args:
            run: Its directory.
            facts: See `hil.runs.listing.facts_of`.

        Raises:
            DataError: Its documents or recordings cannot be read.
        """
        known = self.uids.get(facts["uid"]) or self.names.get(run.name)
        if known := known or self.folders.get(run.resolve().parts[-_BELOW:]):
            return known
        recordings = RunDirectory(run).recordings
        names = {path.name.removesuffix(PARTIAL_SUFFIX) for path in recordings}
        for one in self.vague:
            if (names & one.names or not one.names) and _may_be(one, facts):
                return one.why
        digests = _digests(run, recordings) if self.digests else set()
        return next((why for digest, why in self.digests.items() if digest in digests), "")

    def add_version(self, version: ModelVersion) -> None:
        """Keep what a version came from."""
        facts = version.facts
        why = f"{version.name} {version.label} was fitted to it"
        of_run = facts.get("run") or {}
        if uid := of_run.get("uid"):
            self.uids[str(uid)] = why
        if folder := of_run.get("folder", ""):
            self.folders[Path(str(folder)).parts[-_BELOW:]] = why
        trained = [str(name).removesuffix(PARTIAL_SUFFIX) for name in facts.get("trained_on") or ()]
        files = [name for name in trained if name.endswith(".mcap")]
        named = [name for name in trained if name not in files]
        self.names.update(dict.fromkeys(named, why))
        own = Path(str(folder)).name if folder else ""
        self.by_name.extend(Lost(name, version.folder, why) for name in named if name != own)
        digests = {str(key): str(one) for key, one in (facts.get("data_sha256") or {}).items()}
        self.digests.update(dict.fromkeys(digests.values(), why))
        unknown = _without_digest(files, digests)
        if unknown or not (of_run or trained or digests):
            told = min(unknown, default="it does not say what")
            why = f"it may be what {version.name} {version.label} was fitted to ({told})"
            serial = str(facts.get("serial") or "")
            self.vague.append(Vague(unknown, serial, version.registered, why))


def _may_be(one: Vague, facts: Mapping[str, Any]) -> bool:
    """Whether a run can be what a version was fitted to: of that arm, and begun before."""
    if one.serial and facts["serial"] and one.serial != facts["serial"]:
        return False
    try:
        begun, registered = (datetime.fromisoformat(x) for x in (facts["started"], one.registered))
        return begun <= registered
    except (ValueError, TypeError):
        return True


def _digests(run: Path, recordings: Iterable[Path]) -> set[str]:
    """SHA-256 of a run's recordings: as its stop documents have them, else of the files."""
    noted: dict[str, str] = {}
    for document in run.glob("stop*.json"):
        told = read_json(document).get("sha256")
        noted |= told if isinstance(told, dict) else {}
    found = {digest for name, digest in noted.items() if name.endswith(".mcap")}
    try:
        missing = [path for path in recordings if path.relative_to(run).as_posix() not in noted]
        return found | {sha256_of(path) for path in missing}
    except OSError as error:
        raise DataError(
            f"cannot read {error.filename}: {error.strerror or error}",
            hint="see whether it exists and may be read",
        ) from error


def _without_digest(files: Iterable[str], digests: Iterable[str]) -> frozenset[str]:
    """Names of recordings of which fewer have a digest than a model was fitted to."""
    known = Counter(Path(name).name.removesuffix(PARTIAL_SUFFIX) for name in digests)
    return frozenset(Counter(files) - known)


def origins(registries: Iterable[Path]) -> Origins:
    """What the models of registries came from, and the probes of their champions.

    Args:
        registries: Folders; each must be there.

    Raises:
        RegistryError: One is not there, or anything in it cannot be read: then nobody knows.
    """
    found = Origins()
    for root in registries:
        try:
            _collect(root, found)
        except OSError as error:
            raise RegistryError(
                f"cannot read the registry {root}: {error.strerror or error}",
                hint="nothing is deleted before all registries can be read",
            ) from error
    return found


def _collect(root: Path, found: Origins) -> None:
    if not root.is_dir():
        raise RegistryError(
            f"there is no registry {root}", hint="name the folder of the registered models"
        )
    registry = Registry(root)
    for name in registry.names():
        # Read first: a version that is missing without a repair is an error of the log.
        champion = registry.aliases(name).champion
        for version in registry.versions(name):
            found.add_version(version)
        for probe in probes_of(registry, name):
            if probe.champion == champion:
                why = f"it is a probe of {name} v{champion}"
                found.uids.setdefault(probe.uid, why)
                found.digests.setdefault(probe.uid, why)


def why_by_rows(lost: Iterable[Lost]) -> Callable[[Path], str]:
    """A function of a run that says why it has to stay, empty where none of its rows is known.

    Args:
        lost: Versions whose training sources are not found by name.

    Raises:
        RegistryError: (the function) A version cannot be read.
    """
    versions = list(lost)
    sketch = cache(_sketch)

    def why(run: Path) -> str:
        asked = [(one, rows) for one in versions if (rows := sketch(one.model)) is not None]
        if not asked:
            return ""
        try:
            data = load_source(run, any_arm=True)
        except HilError as error:
            return f"it cannot be told whether a model was fitted to it: {error.message}"
        return next((one.why for one, rows in asked if rows.share_known(data) > 0.0), "")

    return why


def _sketch(model: Path) -> Sketch | None:
    """What a model remembers; None of one that remembers nothing.

    Raises:
        RegistryError: It cannot be read.
    """
    try:
        training = load_model_file(model).training_
    except HilError as error:
        raise RegistryError(
            f"{model} does not say what it was fitted to: {error.message}",
            hint="restore the registry from a backup; nothing is deleted before",
        ) from error
    return training.rows if training is not None and len(training.rows.smallest) else None
