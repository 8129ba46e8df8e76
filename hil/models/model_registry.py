"""Model registry: registration, promotion and rollback of the versions of a model.

Committed data never change: the folder of a version is created atomically, the log is append-only,
and nothing is deleted. If a process dies between the creation of a version's folder and its log
entry, the log lacks this version, and the next writer adds it (`_adopt`). The origin of a model is
collected at its registration (`facts_of`).
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
"""Maximum number of names in the hint of an error."""


def registry(folder: AnyPath = "registry") -> Registry:
    """Return the registry in a folder: models by name, each with versions and a champion.

    Args:
        folder: Folder of the registry; the folder is created at the first registration.
    """
    return Registry(path_of(folder))


class Registry:
    """Registry of named models in a folder.

    Args:
        root: Folder of the registry; the folder is created at the first registration.
    """

    def __init__(self, root: Path) -> None:
        self.root = root

    def __repr__(self) -> str:
        return f"<Registry {self.root}: {', '.join(self.names()) or 'no models'}>"

    def _repr_html_(self) -> str:
        """Return the notebook card: a table with one row per model name."""
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
        """Return all model names in alphabetical order.

        A model name is listed if it has versions, or if its log shows that its versions are
        missing.
        """
        if not self.root.is_dir():
            return []
        return sorted(
            path.name
            for path in self.root.iterdir()
            if numbers_in(path) or (_has_log(path) and inspect(path).problem)
        )

    def versions(self, name: str) -> list[ModelVersion]:
        """Return all versions of a name, oldest first; an empty list if all folders are missing.

        Raises:
            RegistryError: The name does not exist, or one of its versions is damaged.
        """
        home = self._home(name)
        return [read_version(home, number) for number in numbers_in(home)]

    def log(self, name: str) -> tuple[Entry, ...]:
        """Return the log of a name: all events of its versions, oldest first.

        Raises:
            RegistryError: The name does not exist, or its log is damaged.
        """
        return read_log(self._home(name))

    def aliases(self, name: str) -> Aliases:
        """Return champion, challenger and former champions of a name, according to its log.

        Raises:
            RegistryError: The name does not exist, or its log is damaged.
        """
        return Aliases.after(self.log(name))

    def version(self, name: str, which: str = "champion") -> ModelVersion:
        """Return the version that is `champion`, `challenger` or has a number (`3`, `v3`).

        Raises:
            RegistryError: The requested version does not exist.
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
                f"{which!r} is not a version of {name}",
                hint="use champion, challenger or a version: v3",
            )
        return read_version(home, int(digits))

    def load(self, name: str, which: str = "champion") -> RobotEstimator:
        """Load the model of a version, after checking its files against their digests.

        Raises:
            RegistryError: The requested version does not exist, or its files were changed.
            DataError: The model files of the version cannot be read.
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
        """Register a model folder as a version; an identical model is registered only one time.

        Args:
            name: Name of the model, such as the name of the robot in its station.
            model: Model folder. The files of the model folder are copied, so the folder may be
                changed or deleted later.
            facts: Origin of the model; None for the result of `hil.models.model_registry.facts_of`.
            challenger: Flag; if true, the version becomes the challenger.

        Returns:
            The new version, or the existing version if its files are identical.

        Raises:
            RegistryError: The name is invalid, or the registry cannot be written.
            DataError: The model folder contains no readable model.
            SpecError: The argument `facts` is not a mapping.
        """
        require_name(name)
        model = Path(model)
        load_model_file(model)  # raises if the model cannot be read
        facts = facts_of(model) if facts is None else _require_facts(facts)
        files = {p.name: p.read_bytes() for p in sorted(model.iterdir()) if p.is_file()}
        files.pop(VERSION_FILE, None)
        home = self.root / name
        with writing(home):
            self._adopt(home)
            digest = digest_of(files)
            versions = [read_version(home, number) for number in numbers_in(home)]
            version = next((one for one in versions if one.digest == digest), None)
            # Note the registry first, so that the runs of the model cannot be deleted meanwhile.
            note_registry(self.root, _sources(model, facts))
            if version is None:
                # A number in the log is not used again, even if its folder is lost.
                number = max([*numbers_in(home), last_number(read_log(home))]) + 1
                digests = {file: hashlib.sha256(raw).hexdigest() for file, raw in files.items()}
                at, by, folder = utc_now(), operator(), folder_of(home, number)
                version = ModelVersion(name, number, folder, digest, at, by, facts, digests)
                write_version(home, version, files)
                self._adopt(home)
            # The champion cannot become the challenger.
            now = Aliases.after(read_log(home))
            if challenger and version.number not in (now.champion, now.challenger):
                self._log(home, "challenger", version.number)
        return version

    def promote(
        self, name: str, number: int, *, reason: str, evidence: Mapping[str, Any], instead_of: int
    ) -> Aliases:
        """Make a version the champion of its model name.

        Args:
            name: Name of the model.
            number: Number of the version that becomes the champion.
            reason: Reason for the promotion in words.
            evidence: Evidence of the decision, such as a comparison.
            instead_of: Number of the champion with which the version was compared, 0 if there was
                no champion.

        Raises:
            RegistryError: The version does not exist, or the champion has changed since the
                comparison.
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
                    hint=f"compare v{number} with v{now.champion}",
                )
            return self._log(home, "promoted", number, reason, evidence)

    def keep(self, name: str, number: int, *, reason: str, evidence: Mapping[str, Any]) -> Aliases:
        """Log that a version was compared with the champion and that the champion stays.

        Raises:
            RegistryError: The compared version does not exist.
        """
        home = self._home(name)
        read_version(home, number)
        with writing(home):
            self._adopt(home)
            return self._log(home, "kept", number, reason, evidence)

    def roll_back(self, name: str, *, reason: str, to: int = 0) -> Aliases:
        """Make the previous champion, or an earlier champion, champion again.

        Raises:
            RegistryError: There is no previous champion, the version `to` was never champion, or
                the files of the version were changed.
        """
        home = self._home(name)
        with writing(home):
            self._adopt(home)
            before = Aliases.after(read_log(home)).before
            if not before or (to and to not in before):
                was = ", ".join(f"v{one}" for one in before) or "none"
                raise RegistryError(
                    f"{name} cannot be rolled back{f' to v{to}' if to else ''}; previous "
                    f"champions: {was}",
                    hint=f"see the log of {name}: hil models log {name}",
                )
            target = to or before[-1]
            read_version(home, target).verify()
            return self._log(home, "rolled-back", target, reason)

    def rebuild(self, name: str) -> Aliases:
        """Rebuild `aliases.json` from the log, after adding versions missing after a crash.

        Raises:
            RegistryError: The name does not exist, or its log is damaged. Nothing is written if the
                name does not exist or its log is damaged.
        """
        home = self._home(name)
        with writing(home):
            self._adopt(home)
            return _view(home)

    def check(self) -> dict[str, tuple[list[ModelVersion], Aliases]]:
        """Check every file against its digest and every log against its head; rebuild all views.

        Returns:
            Mapping of each model name to its versions and roles.

        Raises:
            RegistryError: One or more model names are damaged; the message lists all problems.
                Nothing is written for a damaged model name.
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
        """Return the problem of a name's log, or None if the log is intact; no file is written.

        Raises:
            RegistryError: The name does not exist, or its log cannot be read.
        """
        home = self._home(name)
        problem = inspect(home).problem
        return damaged(home, problem) if problem else None

    def repair(self, name: str) -> Repair | None:
        """Rebuild a damaged log from its intact lines and the version folders.

        Copies of the old files of the name are stored in a separate folder before the repair.

        Returns:
            Summary of the repair; None if the log was intact.

        Raises:
            RegistryError: The name does not exist, one of its versions is damaged, or a file cannot
                be written.
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
        """Return the hint of the error for a model name that does not exist."""
        names = self.names()
        if guess := closest(name, names):
            return f"did you mean {guess!r}?"
        few = ", ".join(names[:FEW]) + (", …" if len(names) > FEW else "")
        return (
            f"the registry has {few}: hil models list"
            if names
            else "register one: hil models register"
        )

    def _adopt(self, home: Path) -> None:
        """Add existing version folders that the log lacks to the log, which must be intact."""
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
            f"expected a mapping as facts, got {facts!r:.80}",
            hint="omit facts: they are read from the model and its run",
        )
    return dict(facts)


def _sources(model: Path, facts: Mapping[str, Any]) -> list[Path]:
    """Return the folder of a model and the recordings it was fitted to, as far as known."""
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
    """Raise if a name is not a valid folder name on every operating system.

    Raises:
        RegistryError: The model name is invalid.
    """
    if not _NAME.match(name):
        raise RegistryError(
            f"{name!r} cannot be the name of a model",
            hint="use letters, digits, dots, dashes and underscores, at most 64",
        )


FIT_FOLDER = "fit"


def facts_of(model: Path, sources: Iterable[Path] = ()) -> dict[str, Any]:
    """Return the origin of a model, as stored in `version.json`.

    A model under `RUN/fit/`, or a model that was fitted to one run alone, belongs to that run. The
    documents of a run contain the digests of its recordings.

    Args:
        model: Folder of the model.
        sources: Recordings to which the model was fitted; used only if the model does not belong to
            a run.

    Raises:
        DataError: The documents of the model or of the run cannot be read.
        RegistryError: One of `sources` does not exist.
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
    """Return path → SHA-256 of recordings: those logged by a finished run, and those in `sources`.

    Recordings of different runs may have the same file name. The second recording with the same
    file name is then listed with its whole path.
    """
    digests: dict[str, str] = {}
    for stop in sorted(run.glob("stop*.json")) if run is not None else ():  # one per attempt
        noted = read_json(stop).get("sha256", {})
        # A recording that a crash has cut off counts: its complete part is training data.
        digests |= {
            name: digest
            for name, digest in noted.items()
            if name.removesuffix(PARTIAL_SUFFIX).endswith(".mcap")
        }
    for source in sources:
        if not source.exists():
            raise RegistryError(f"{source} does not exist", hint="give existing recordings or runs")
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
    """Return the totals of `evaluation.json` without its tables."""
    path = model / EVALUATION_FILE
    if not path.is_file():
        return None
    try:
        document = json.loads(path.read_bytes())
    except ValueError as error:
        raise DataError(
            f"{path} is not a valid evaluation: {error}", hint="fit the model again"
        ) from error
    if not isinstance(document, dict):
        return None
    held_out = document.get("held_out") or {}
    # A run has one hold-out set, whereas `hil fit` writes one entry per held-out source.
    parts = [
        {"source": held_out.get("what", ""), **held_out},
        *({"total": one, **one} for one in document.get("validation") or ()),
    ]
    keys = ("source", "unit", "total", "notes")
    return [{key: part[key] for key in keys if part.get(key)} for part in parts if "total" in part]
