"""Training runs of registered models, which no retention policy may delete.

Each model version stores its run, its training sources and the digests of its training recordings.
A run is kept if its identity, its name or the digest of a recording matches a model version
(`Origins.why`). If a model version stores too little information, every run that possibly matches
is kept. A run that was renamed after the training of a model no longer matches the model by name. A
renamed run is recognized by the rows of training data that the model stores (`hil.data.Sketch`,
`why_by_rows`).
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
    """Model version that was fitted to recordings whose digests are not stored.

    Attributes:
        names: Names of the recordings; empty if the names are not known either.
        serial: Serial number of the robot; empty if it is unknown.
        registered: Registration time of the model version (ISO 8601); a run that started later
            cannot be a training run.
        why: Reason that is reported for keeping a run that is possibly a training run.
    """

    names: frozenset[str]
    serial: str
    registered: str
    why: str

    def may_be(self, facts: Mapping[str, Any]) -> bool:
        """Return whether a run is of the same robot and was started before the registration.

        An unknown serial number or time counts as a match.
        """
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
    """Model version whose training run is known only by name and possibly has a new name."""

    name: str
    model: Path
    why: str


_BELOW = 3
"""Number of last path components that identify a run in any folder of runs.

The path components are the day, the robot and the run directory.
"""


@dataclass(frozen=True, slots=True)
class Origins:
    """Training data of models and probe runs of champions, with reasons for keeping these data.

    Attributes:
        uids: Identities of runs, and digests of recordings that were used as probes.
        folders: Last `_BELOW` path components of run directories.
        names: Names of the run directories of training runs and probe runs.
        digests: SHA-256 digests of the recordings.
        vague: Model versions whose training runs cannot be identified uniquely.
        by_name: Model versions with a training run that is known only by its name.
    """

    uids: dict[str, str] = field(default_factory=dict)
    folders: dict[tuple[str, ...], str] = field(default_factory=dict)
    names: dict[str, str] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)
    vague: list[Vague] = field(default_factory=list)
    by_name: list[Lost] = field(default_factory=list)

    def why(self, run: Path, facts: Mapping[str, Any]) -> str:
        """Return the reason for keeping a run; empty if no model depends on the run.

        Args:
            run: Path of the run directory.
            facts: Entry of the run with the keys described in `hil.runs.listing.facts_of`.

        Raises:
            DataError: The documents or recordings of the run cannot be read.
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
        """Add the training data of a model version."""
        facts = version.facts
        why = f"{version.name} {version.label} was fitted to it"
        of_run = facts.get("run") or {}
        if uid := of_run.get("uid"):
            self.uids[str(uid)] = why
        if folder := of_run.get("folder", ""):
            self.folders[Path(str(folder)).parts[-_BELOW:]] = why
        trained = [str(name).removesuffix(PARTIAL_SUFFIX) for name in facts.get("trained_on") or ()]
        # A training source is the name of a recording or of a run directory.
        files = [name for name in trained if name.endswith(".mcap")]
        folders = [name for name in trained if name not in files]
        self.names.update(dict.fromkeys(folders, why))
        own = Path(str(folder)).name if folder else ""
        self.by_name.extend(Lost(name, version.folder, why) for name in folders if name != own)
        digests = {str(key): str(one) for key, one in (facts.get("data_sha256") or {}).items()}
        self.digests.update(dict.fromkeys(digests.values(), why))
        unknown = _without_digest(files, digests)
        if unknown or not (of_run or trained or digests):
            what = min(unknown, default="the model does not name its data")
            why = f"{version.name} {version.label} was possibly fitted to it ({what})"
            serial = str(facts.get("serial") or "")
            self.vague.append(Vague(unknown, serial, version.registered, why))


def _digests(run: Path, recordings: Iterable[Path]) -> set[str]:
    """Return the SHA-256 digests of the recordings of a run.

    The digests are read from the stop documents; for recordings that these documents omit, the
    digests are computed from the files.
    """
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
            hint="check whether it exists and its permissions",
        ) from error


def _without_digest(files: Iterable[str], digests: Iterable[str]) -> frozenset[str]:
    """Return the names of recordings that are more frequent in `files` than in the digests."""
    known = Counter(Path(name).name.removesuffix(PARTIAL_SUFFIX) for name in digests)
    return frozenset(Counter(files) - known)


def origins(registries: Iterable[Path]) -> Origins:
    """Return the training data of all models in the registries and the probes of their champions.

    Args:
        registries: Paths of the registry folders; each folder must exist.

    Raises:
        RegistryError: A registry does not exist or cannot be read completely; its training runs are
            therefore unknown.
    """
    known = Origins()
    for root in registries:
        try:
            _collect(root, known)
        except OSError as error:
            raise RegistryError(
                f"cannot read the registry {root}: {error.strerror or error}",
                hint="nothing is deleted until all registries can be read",
            ) from error
    return known


def _collect(root: Path, known: Origins) -> None:
    if not root.is_dir():
        raise RegistryError(
            f"there is no registry {root}", hint="name the folder of the registered models"
        )
    registry = Registry(root)
    for name in registry.names():
        # Read the log first: a damaged log must raise even if version folders are missing.
        champion = registry.aliases(name).champion
        for version in registry.versions(name):
            known.add_version(version)
        for probe in probes_of(registry, name):
            if probe.champion == champion:
                why = f"it is a probe of {name} v{champion}"
                known.uids.setdefault(probe.uid, why)
                known.digests.setdefault(probe.uid, why)  # the uid of a probe can be a digest


def why_by_rows(lost: Iterable[Lost]) -> Callable[[Path], str]:
    """Return a function that checks by means of stored rows whether a run was used for training.

    The returned function maps a run directory to the reason for keeping the run. The returned
    reason is empty if no model stores a row of the run. The returned function raises RegistryError
    if a model version cannot be read.

    Args:
        lost: Model versions whose training sources are not found by name.
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
            return f"a model was possibly fitted to it, its data cannot be read: {error.message}"
        return next((one.why for one, rows in remembered if rows.share_known(data) > 0.0), "")

    return why


def _sketch(model: Path) -> Sketch | None:
    """Return the rows of training data that a model stores; None if there are no rows.

    Raises:
        RegistryError: The files of the model cannot be read.
    """
    try:
        training = load_model_file(model).training_
    except HilError as error:
        raise RegistryError(
            f"the training data of {model} are unknown: {error.message}",
            hint="restore the registry from a backup; nothing is deleted until then",
        ) from error
    return training.rows if training is not None and len(training.rows.smallest) else None
