"""The registry: models under names, in versions; registered, promoted, rolled back.

Whatever is committed stays: a version's folder appears whole, the log only grows, and nothing is
deleted. A process that dies between folder and log leaves a version that the log does not have yet;
the next writer enters it (`_adopt`). Where a model came from is collected when it is registered
(`facts_of`).
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from hil.core import (
    AnyPath,
    DataError,
    RegistryError,
    SpecError,
    card,
    closest,
    path_of,
    read_json,
    sha256_of,
)
from hil.estimators import MODEL_FILE, RobotEstimator, load_model_file
from hil.evaluation import EVALUATION_FILE
from hil.models.log import (
    HEAD_FILE,
    LOG_FILE,
    Aliases,
    Entry,
    Event,
    Repair,
    append,
    damaged,
    inspect,
    last_number,
    read_log,
    registered_in,
    repair,
    settle,
    write_view,
    writing,
)
from hil.models.registries_file import note_registry
from hil.models.version import (
    VERSION_FILE,
    ModelVersion,
    digest_of,
    folder_of,
    numbers_in,
    read_version,
    write_version,
)
from hil.recording import PARTIAL_SUFFIX, operator, package_versions, source_revision, utc_now

FEW = 5
"""Names that a hint lists."""


def registry(folder: AnyPath = "registry") -> Registry:
    """Return the registry of a folder: models under names, in versions, with their champions.

    Args:
        folder: Made when something is registered.
    """
    return Registry(path_of(folder))


class Registry:
    """A folder of named models.

    Args:
        root: Made when something is registered.
    """

    def __init__(self, root: Path) -> None:
        self.root = root

    def __repr__(self) -> str:
        return f"<Registry {self.root}: {', '.join(self.names()) or 'no models'}>"

    def _repr_html_(self) -> str:
        """Return the card for a notebook: a row per name."""
        rows = []
        for name in self.names():
            labels = ("log damaged", "–")
            if not self.problem(name):
                now = self.aliases(name)
                labels = (_label(now.champion), _label(now.challenger))
            rows.append((name, len(self.versions(name)), *labels))
        head = ("name", "versions", "champion", "challenger")
        notes = [] if rows else ["no models yet"]
        return card("Registry", self.root, {}, table=(head, rows) if rows else None, notes=notes)

    def names(self) -> list[str]:
        """Return the names that have versions, or have lost them without a repair, in order."""
        if not self.root.is_dir():
            return []
        return sorted(
            path.name
            for path in self.root.iterdir()
            if numbers_in(path) or (_has_log(path) and inspect(path).problem)
        )

    def versions(self, name: str) -> list[ModelVersion]:
        """Return all versions of a name, oldest first; none if all folders are missing.

        Raises:
            RegistryError: There is no such name, or one is damaged.
        """
        home = self._home(name)
        return [read_version(home, number) for number in numbers_in(home)]

    def log(self, name: str) -> tuple[Entry, ...]:
        """Return what was done to the versions of a name, oldest first.

        Raises:
            RegistryError: There is no such name, or its log is damaged.
        """
        return read_log(self._home(name))

    def aliases(self, name: str) -> Aliases:
        """Return champion, challenger and earlier champions, by the log.

        Raises:
            RegistryError: There is no such name, or its log is damaged.
        """
        return Aliases.after(self.log(name))

    def version(self, name: str, which: str = "champion") -> ModelVersion:
        """Return a version by `champion`, `challenger` or number (`3`, `v3`).

        Raises:
            RegistryError: There is none.
        """
        home = self._home(name)
        if which in ("champion", "challenger"):
            aliases = self.aliases(name)
            number = aliases.champion if which == "champion" else aliases.challenger
            if not number:
                raise RegistryError(
                    f"{name} has no {which}", hint=f"see its versions with: hil models show {name}"
                )
            return read_version(home, number)
        if not (digits := which.removeprefix("v")).isdecimal():
            raise RegistryError(
                f"{which!r} is no version of {name}", hint="give champion, challenger, or v3"
            )
        return read_version(home, int(digits))

    def load(self, name: str, which: str = "champion") -> RobotEstimator:
        """Return the model of a version; its files are compared with their digests first.

        Raises:
            RegistryError: There is none, or its files were changed.
            DataError: They cannot be read.
        """
        version = self.version(name, which)
        version.verify()
        return load_model_file(version.folder)

    def register(
        self,
        name: str,
        model: str | Path,
        facts: Mapping[str, Any] | None = None,
        *,
        challenger: bool = False,
    ) -> ModelVersion:
        """Add a model folder as a version; the same model twice is one version.

        Args:
            name: Such as the robot's in its station.
            model: Folder; read once, so that it may change or go afterwards.
            facts: What is known of it; by default those of `hil.models.model_registry.facts_of`.
            challenger: Make it the one to be compared with the champion.

        Returns:
            The new version, or the one that has the same files.

        Raises:
            RegistryError: The name cannot be, or the registry cannot be written.
            DataError: The folder holds no model that can be read.
            SpecError: The facts are no values by name.
        """
        require_name(name)
        model = Path(model)
        load_model_file(model)  # what cannot be read is not registered
        facts = facts_of(model) if facts is None else _require_facts(facts)
        files = {p.name: p.read_bytes() for p in sorted(model.iterdir()) if p.is_file()}
        files.pop(VERSION_FILE, None)
        home = self.root / name
        with writing(home):
            self._adopt(home)
            digest = digest_of(files)
            versions = [read_version(home, number) for number in numbers_in(home)]
            version = next((one for one in versions if one.digest == digest), None)
            # Before the version: the runs it came from must not be deleted in between.
            note_registry(self.root, _sources(model, facts))
            if version is None:
                # A number that the log has named stays taken, even if its folder is lost.
                number = max([*numbers_in(home), last_number(read_log(home))]) + 1
                digests = {file: hashlib.sha256(raw).hexdigest() for file, raw in files.items()}
                at, by, folder = utc_now(), operator(), folder_of(home, number)
                version = ModelVersion(name, number, folder, digest, at, by, facts, digests)
                write_version(home, version, files)
                self._adopt(home)
            # A champion cannot challenge itself.
            now = Aliases.after(read_log(home))
            if challenger and version.number not in (now.champion, now.challenger):
                self._log(home, "challenger", version.number)
        return version

    def promote(
        self, name: str, number: int, *, reason: str, evidence: Mapping[str, Any], instead_of: int
    ) -> Aliases:
        """Make a version the champion.

        Args:
            name: Of the models.
            number: Of the version.
            reason: In words.
            evidence: What the decision rests on, such as a comparison.
            instead_of: Champion it was compared with, 0 for none.

        Raises:
            RegistryError: There is no such version, or the champion is another one by now.
        """
        home = self._home(name)
        read_version(home, number).verify()
        with writing(home):
            self._adopt(home)
            now = Aliases.after(read_log(home))
            if now.champion == number:
                return now
            if now.champion != instead_of:
                raise RegistryError(
                    f"{name}: v{number} was compared with v{instead_of}, but v{now.champion} has "
                    "become champion meanwhile",
                    hint="compare it with that one",
                )
            return self._log(home, "promoted", number, reason, evidence)

    def keep(self, name: str, number: int, *, reason: str, evidence: Mapping[str, Any]) -> Aliases:
        """Note that a version was compared, and that the champion stays.

        Raises:
            RegistryError: There is no such version.
        """
        home = self._home(name)
        read_version(home, number)
        with writing(home):
            self._adopt(home)
            return self._log(home, "kept", number, reason, evidence)

    def roll_back(self, name: str, *, reason: str, to: int = 0) -> Aliases:
        """Make the champion before the present one champion again, or an earlier one.

        Raises:
            RegistryError: There was none, or it was never champion, or its files were changed.
        """
        home = self._home(name)
        with writing(home):
            self._adopt(home)
            before = Aliases.after(read_log(home)).before
            if not before or (to and to not in before):
                was = ", ".join(f"v{one}" for one in before) or "no other"
                raise RegistryError(
                    f"{name} cannot go back{f' to v{to}' if to else ''}: champion before this one "
                    f"was {was}",
                    hint=f"see what was done with: hil models log {name}",
                )
            target = to or before[-1]
            read_version(home, target).verify()
            return self._log(home, "rolled-back", target, reason)

    def rebuild(self, name: str) -> Aliases:
        """Make the view from the log anew, after entering versions that a crash has left out of it.

        Raises:
            RegistryError: There is no such name, or its log is damaged: nothing is written then.
        """
        home = self._home(name)
        with writing(home):
            self._adopt(home)
            return _view(home)

    def check(self) -> dict[str, tuple[list[ModelVersion], Aliases]]:
        """Compare every file with its digest and every log with its head; rebuild the views.

        Returns:
            Versions and roles by name.

        Raises:
            RegistryError: With all problems; nothing is written for a damaged name.
        """
        sound, problems = {}, list[RegistryError]()
        for name in self.names():
            try:
                versions = self.versions(name)
                for version in versions:
                    version.verify()
                sound[name] = versions, self.rebuild(name)
            except RegistryError as error:
                problems.append(error)
        if problems:
            message = "; ".join(problem.message for problem in problems)
            raise RegistryError(message, hint=problems[0].hint) from problems[0]
        return sound

    def problem(self, name: str) -> RegistryError | None:
        """Return what is wrong with a name's log; None where it is sound. Writes nothing.

        Raises:
            RegistryError: There is no such name, or its log cannot be read.
        """
        home = self._home(name)
        problem = inspect(home).problem
        return damaged(home, problem) if problem else None

    def repair(self, name: str) -> Repair | None:
        """Rebuild a damaged log from its intact lines and the version folders.

        Copies of the old files stay in a folder of their own.

        Returns:
            What was done; None where the log is sound.

        Raises:
            RegistryError: There is no such name, a version is damaged, or nothing can be written.
        """
        home = self._home(name)
        with writing(home):
            outcome = repair(home)
            self._adopt(home)
            _view(home)
            return outcome

    def _home(self, name: str) -> Path:
        require_name(name)
        home = self.root / name
        if not numbers_in(home) and not _has_log(home):
            raise RegistryError(f"{self.root} has no models of {name}", hint=self._others(name))
        return home

    def _others(self, name: str) -> str:
        """Return the hint for a name that is not there."""
        names = self.names()
        if guess := closest(name, names):
            return f"did you mean {guess!r}?"
        few = ", ".join(names[:FEW]) + (", …" if len(names) > FEW else "")
        return f"there is {few}: hil models list" if names else "register one: hil models register"

    def _adopt(self, home: Path) -> None:
        """Enter versions whose folders are there into the log, which must be sound."""
        logged = registered_in(settle(home).entries)
        for number in numbers_in(home):
            if number not in logged:
                version = read_version(home, number)
                append(home, Entry("registered", number, version.registered, version.by))

    def _log(
        self,
        home: Path,
        event: Event,
        number: int,
        reason: str = "",
        evidence: Mapping[str, Any] | None = None,
    ) -> Aliases:
        append(home, Entry(event, number, utc_now(), operator(), reason, evidence or {}))
        return _view(home)


def _label(number: int) -> str:
    return f"v{number}" if number else "–"


def _require_facts(facts: Mapping[str, Any]) -> dict[str, Any]:
    if not isinstance(facts, Mapping):
        raise SpecError(
            f"facts are {facts!r:.80}, not values by name",
            hint="leave them out: the model and its run tell them",
        )
    return dict(facts)


def _sources(model: Path, facts: Mapping[str, Any]) -> list[Path]:
    """Return where a model lies and what it was fitted to, as far as known."""
    folder = (facts.get("run") or {}).get("folder")
    return [model, *(Path(str(one)) for one in (folder, *facts.get("data", ())) if one)]


def _has_log(home: Path) -> bool:
    return (home / LOG_FILE).exists() or (home / HEAD_FILE).exists()


def _view(home: Path) -> Aliases:
    aliases = Aliases.after(read_log(home))
    write_view(home, aliases)
    return aliases


_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}\Z")


def require_name(name: str) -> None:
    """Refuse what cannot be a folder of its own everywhere.

    Raises:
        RegistryError: It cannot.
    """
    if not _NAME.match(name):
        raise RegistryError(
            f"{name!r} cannot be the name of a model",
            hint="use letters, digits, dots, dashes and underscores, at most 64",
        )


FIT_FOLDER = "fit"


def facts_of(model: Path, sources: Iterable[Path] = ()) -> dict[str, Any]:
    """Return what is known of where a model came from, for `version.json`.

    A model under `RUN/fit/`, or fitted to one run alone, is of that run, which has the digests of
    its recordings.

    Args:
        model: Its folder.
        sources: Recordings it was fitted to, if it is not of a run.

    Raises:
        DataError: The model's documents or the run's cannot be read.
        RegistryError: A source is not there.
    """
    document = read_json(model / MODEL_FILE)
    fitted, training = document.get("fitted", {}), document.get("training") or {}
    sources = list(sources)
    run = model.resolve().parent.parent if model.resolve().parent.name == FIT_FOLDER else None
    if run is None and len(sources) == 1 and (sources[0] / "start.json").is_file():
        run = sources[0].resolve()
    return {
        "estimator": document["estimator"],
        "protocol": fitted.get("protocol", ""),
        "robot": document["robot"].get("name", ""),
        "joint_names": fitted.get("joint_names", []),
        "effort_kind": fitted.get("effort_kind", ""),
        "serial": training.get("serial", ""),
        "trained_on": training.get("sources", []),
        "data": [str(source.resolve()) for source in sources],
        "data_sha256": _digests(run, sources),
        "run": _run(run),
        "evaluation": _evaluation(model),
        "packages": package_versions(),
        "git": source_revision(),
    }


def _digests(run: Path | None, sources: Iterable[Path]) -> dict[str, str]:
    """Return path → SHA-256 of recordings: those a finished run has noted, and the sources.

    Recordings of several runs have the same names: the second of a name stands with its whole path.
    """
    digests: dict[str, str] = {}
    for stop in sorted(run.glob("stop*.json")) if run is not None else ():  # one per attempt
        noted = read_json(stop).get("sha256", {})
        # Also one that a crash has cut off: what is whole in it is learned from.
        digests |= {
            name: digest
            for name, digest in noted.items()
            if name.removesuffix(PARTIAL_SUFFIX).endswith(".mcap")
        }
    for source in sources:
        if not source.exists():
            raise RegistryError(f"{source} is not there", hint="name the recordings as they are")
        whole = source.is_dir()
        noted = _digests(source, ()) if whole else {source.name: sha256_of(source)}
        for name, digest in noted.items():
            taken = digests.get(name, digest) != digest
            digests[str((source if whole else source.parent) / name) if taken else name] = digest
    return digests


def _run(run: Path | None) -> dict[str, Any] | None:
    if run is None or not (run / "start.json").is_file():
        return None
    start = read_json(run / "start.json")
    keys = ("uid", "started", "operator", "host", "experiment", "robot_name", "seed")
    verdict = run / "verdict.json"
    return {
        **{key: start.get(key) for key in keys},
        "folder": str(run),
        "verdict": read_json(verdict) if verdict.is_file() else None,
    }


def _evaluation(model: Path) -> Any:
    """Return the totals of `evaluation.json`; its tables stay in the file."""
    path = model / EVALUATION_FILE
    if not path.is_file():
        return None
    try:
        document = json.loads(path.read_bytes())
    except ValueError as error:
        raise DataError(f"{path} is no evaluation: {error}", hint="fit the model again") from error
    if not isinstance(document, dict):
        return None
    held_out = document.get("held_out") or {}
    # A run has one hold-out of its own, `hil fit` an entry per held-out source.
    parts = [
        {"source": held_out.get("what", ""), **held_out},
        *({"total": one, **one} for one in document.get("validation") or ()),
    ]
    keys = ("source", "unit", "total", "notes")
    return [{key: part[key] for key in keys if part.get(key)} for part in parts if "total" in part]
