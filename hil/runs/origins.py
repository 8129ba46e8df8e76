"""Which runs registered models came from: runs that no policy may delete.

A version's facts name its run, its training sources and the digests of their recordings. A run that
any of them fits is kept (`Origins.why`); if they say too little, every run that may be meant is
kept. A run that was renamed leaves its models with a name that leads nowhere: it is still found by
the rows that a model remembers of its training data (`hil.data.Sketch`, `why_by_rows`).
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
    """A version that was fitted to recordings without a known digest.

    Attributes:
        names: Of these recordings; empty if they are not known either.
        serial: Of the robot; empty if not known.
        registered: When it was registered: no later run can be meant.
        why: The reason for keeping a run that may be meant.
    """

    names: frozenset[str]
    serial: str
    registered: str
    why: str

    def may_be(self, facts: Mapping[str, Any]) -> bool:
        """Return whether a run is of the same arm and was started before, as far as known."""
        if self.serial and facts["serial"] and self.serial != facts["serial"]:
            return False
        try:
            moments = (facts["started"], self.registered)
            started, registered = (datetime.fromisoformat(moment) for moment in moments)
            return started <= registered
        except (ValueError, TypeError):
            return True


@dataclass(frozen=True, slots=True)
class Lost:
    """A version that was fitted to a run of this name, which may have been renamed since."""

    name: str
    model: Path
    why: str


_BELOW = 3
"""Parts of a run's path that stay when all runs are moved together: day, robot, directory."""


@dataclass(frozen=True, slots=True)
class Origins:
    """What models and probes came from, each with the reason for keeping it.

    Attributes:
        uids: Identities of runs, and digests of recordings that were probes.
        folders: Last parts of the paths of runs.
        names: Names of run directories.
        digests: SHA-256 of recordings.
        vague: Versions whose runs may be any of several.
        by_name: Versions that know a training run by nothing but its name.
    """

    uids: dict[str, str] = field(default_factory=dict)
    folders: dict[tuple[str, ...], str] = field(default_factory=dict)
    names: dict[str, str] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)
    vague: list[Vague] = field(default_factory=list)
    by_name: list[Lost] = field(default_factory=list)

    def why(self, run: Path, facts: Mapping[str, Any]) -> str:
        """Return why a run has to stay; empty if no model came from it.

        Args:
            run: Its directory.
            facts: See `hil.runs.listing.facts_of`.

        Raises:
            DataError: Its documents or recordings cannot be read.
        """
        why = self.uids.get(facts["uid"]) or self.names.get(run.name)
        if why := why or self.folders.get(run.resolve().parts[-_BELOW:]):
            return why
        recordings = RunDirectory(run).recordings
        names = {path.name.removesuffix(PARTIAL_SUFFIX) for path in recordings}
        for one in self.vague:
            if (names & one.names or not one.names) and one.may_be(facts):
                return one.why
        digests = _digests(run, recordings) if self.digests else set()
        return next((why for digest, why in self.digests.items() if digest in digests), "")

    def add_version(self, version: ModelVersion) -> None:
        """Add what a version came from."""
        facts = version.facts
        why = f"{version.name} {version.label} was fitted to it"
        of_run = facts.get("run") or {}
        if uid := of_run.get("uid"):
            self.uids[str(uid)] = why
        if folder := of_run.get("folder", ""):
            self.folders[Path(str(folder)).parts[-_BELOW:]] = why
        trained = [str(name).removesuffix(PARTIAL_SUFFIX) for name in facts.get("trained_on") or ()]
        # Training sources are named by their last part: recordings, or run directories.
        files = [name for name in trained if name.endswith(".mcap")]
        folders = [name for name in trained if name not in files]
        self.names.update(dict.fromkeys(folders, why))
        own = Path(str(folder)).name if folder else ""
        self.by_name.extend(Lost(name, version.folder, why) for name in folders if name != own)
        digests = {str(key): str(one) for key, one in (facts.get("data_sha256") or {}).items()}
        self.digests.update(dict.fromkeys(digests.values(), why))
        unknown = _without_digest(files, digests)
        if unknown or not (of_run or trained or digests):
            what = min(unknown, default="it does not say what")
            why = f"it may be what {version.name} {version.label} was fitted to ({what})"
            serial = str(facts.get("serial") or "")
            self.vague.append(Vague(unknown, serial, version.registered, why))


def _digests(run: Path, recordings: Iterable[Path]) -> set[str]:
    """Return the SHA-256 of a run's recordings: from its stop documents, else of the files."""
    noted: dict[str, str] = {}
    for document in run.glob("stop*.json"):
        sums = read_json(document).get("sha256")
        noted |= sums if isinstance(sums, dict) else {}
    digests = {digest for name, digest in noted.items() if name.endswith(".mcap")}
    try:
        missing = [path for path in recordings if path.relative_to(run).as_posix() not in noted]
        return digests | {sha256_of(path) for path in missing}
    except OSError as error:
        raise DataError(
            f"cannot read {error.filename}: {error.strerror or error}",
            hint="see whether it exists and may be read",
        ) from error


def _without_digest(files: Iterable[str], digests: Iterable[str]) -> frozenset[str]:
    """Return the names of recordings of which fewer have a digest than a model was fitted to."""
    known = Counter(Path(name).name.removesuffix(PARTIAL_SUFFIX) for name in digests)
    return frozenset(Counter(files) - known)


def origins(registries: Iterable[Path]) -> Origins:
    """Return what the models of registries came from, and the probes of their champions.

    Args:
        registries: Folders; each must be there.

    Raises:
        RegistryError: One is not there, or anything in it cannot be read: runs of its models are
            unknown then.
    """
    known = Origins()
    for root in registries:
        try:
            _collect(root, known)
        except OSError as error:
            raise RegistryError(
                f"cannot read the registry {root}: {error.strerror or error}",
                hint="nothing is deleted before all registries can be read",
            ) from error
    return known


def _collect(root: Path, known: Origins) -> None:
    if not root.is_dir():
        raise RegistryError(
            f"there is no registry {root}", hint="name the folder of the registered models"
        )
    registry = Registry(root)
    for name in registry.names():
        # Read first: a version that is missing without a repair is an error of the log.
        champion = registry.aliases(name).champion
        for version in registry.versions(name):
            known.add_version(version)
        for probe in probes_of(registry, name):
            if probe.champion == champion:
                why = f"it is a probe of {name} v{champion}"
                known.uids.setdefault(probe.uid, why)
                known.digests.setdefault(probe.uid, why)  # the probe may be a recording


def why_by_rows(lost: Iterable[Lost]) -> Callable[[Path], str]:
    """Return a function of a run that returns why it has to stay, by its rows.

    The function returns an empty text if no model remembers a row of the run.

    Args:
        lost: Versions whose training sources are not found by name.

    Raises:
        RegistryError: (the function) A version cannot be read.
    """
    versions = list(lost)
    sketch = cache(_sketch)

    def why(run: Path) -> str:
        remembered = [(one, rows) for one in versions if (rows := sketch(one.model)) is not None]
        if not remembered:
            return ""
        try:
            data = load_source(run, any_arm=True)
        except HilError as error:
            return f"it cannot be told whether a model was fitted to it: {error.message}"
        return next((one.why for one, rows in remembered if rows.share_known(data) > 0.0), "")

    return why


def _sketch(model: Path) -> Sketch | None:
    """Return the rows that a model remembers of its training data; None without any.

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
