"""Models under names, in versions: registered, promoted, rolled back.

Whatever is committed stays: folders appear whole, the log only grows, and nothing is deleted. A
process that dies between the two leaves a version that the log does not know yet; the next writer
enters it. What is known of where a model came from is collected when it is registered
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
from hil.models.pointers import leave_pointer
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
    """Models under names, in versions: who is champion, who was, and why.

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
        """Itself in a notebook: a row per name."""
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
        """Names that have versions or have lost them without a repair, in order."""
        if not self.root.is_dir():
            return []
        return sorted(
            path.name
            for path in self.root.iterdir()
            if numbers_in(path) or (_has_log(path) and inspect(path).problem)
        )

    def versions(self, name: str) -> list[ModelVersion]:
        """All of a name, oldest first; none if all folders are missing.

        Raises:
            RegistryError: There is no such name, or one is damaged.
        """
        home = self._home(name)
        return [read_version(home, number) for number in numbers_in(home)]

    def log(self, name: str) -> tuple[Entry, ...]:
        """What was done to a name's versions.

        Raises:
            RegistryError: There is no such name, or its log is damaged.
        """
        return read_log(self._home(name))

    def aliases(self, name: str) -> Aliases:
        """Champion and challenger by the log."""
        return Aliases.after(self.log(name))

    def version(self, name: str, which: str = "champion") -> ModelVersion:
        """A version by `champion`, `challenger` or number (`3`, `v3`).

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
        """The model itself, its files compared with their digests first.

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
            facts: What is known of it; by default what `hil.models.model_registry.facts_of` tells.
            challenger: Make it the one to be compared with the champion.

        Raises:
            RegistryError: The name cannot be, or the registry cannot be written.
            DataError: The folder holds no model that can be read.
            SpecError: The facts are none.
        """
        require_name(name)
        model = Path(model)
        load_model_file(model)
        known_of = _facts(model, facts)
        files = {p.name: p.read_bytes() for p in sorted(model.iterdir()) if p.is_file()}
        files.pop(VERSION_FILE, None)
        home = self.root / name
        with writing(home):
            self._adopt(home)
            digest = digest_of(files)
            known = [read_version(home, number) for number in numbers_in(home)]
            found = next((one for one in known if one.digest == digest), None)
            # Before the version: what it came from must not go in between.
            leave_pointer(self.root, _sources(model, known_of))
            if found is None:
                # A number that the log has named stays taken, even if its folder is lost.
                number = max([*numbers_in(home), last_number(read_log(home))]) + 1
                named = {file: hashlib.sha256(raw).hexdigest() for file, raw in files.items()}
                at, by, where = utc_now(), operator(), folder_of(home, number)
                found = ModelVersion(name, number, where, digest, at, by, known_of, named)
                write_version(home, found, files)
                self._adopt(home)
            # A champion cannot challenge itself.
            now = Aliases.after(read_log(home))
            if challenger and found.number not in (now.champion, now.challenger):
                self._do(home, "challenger", found.number)
        return found

    def promote(
        self, name: str, number: int, *, reason: str, evidence: Mapping[str, Any], instead_of: int
    ) -> Aliases:
        """Make a version the champion.

        Args:
            name: Whose.
            number: Which.
            reason: In words.
            evidence: What it rests on.
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
            return self._do(home, "promoted", number, reason, evidence)

    def keep(self, name: str, number: int, *, reason: str, evidence: Mapping[str, Any]) -> Aliases:
        """Note that a version was compared, and that the champion stays.

        Raises:
            RegistryError: There is no such version.
        """
        home = self._home(name)
        read_version(home, number)
        with writing(home):
            self._adopt(home)
            return self._do(home, "kept", number, reason, evidence)

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
            return self._do(home, "rolled-back", target, reason)

    def rebuild(self, name: str) -> Aliases:
        """Make the views from versions and log, and enter versions a crash has kept from it.

        Raises:
            RegistryError: There is no such name, or its log is damaged: nothing is written then.
        """
        home = self._home(name)
        with writing(home):
            self._adopt(home)
            return _view(home)

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
            done = repair(home)
            self._adopt(home)
            _view(home)
            return done

    def _home(self, name: str) -> Path:
        require_name(name)
        home = self.root / name
        if not numbers_in(home) and not _has_log(home):
            raise RegistryError(f"{self.root} has no models of {name}", hint=self._others(name))
        return home

    def _others(self, name: str) -> str:
        """What is there instead of a name that is not."""
        names = self.names()
        if guess := closest(name, names):
            return f"did you mean {guess!r}?"
        few = ", ".join(names[:FEW]) + (", …" if len(names) > FEW else "")
        return f"there is {few}: hil models list" if names else "register one: hil models register"

    def _adopt(self, home: Path) -> None:
        """Enter versions that are there and not in the log, which must be sound."""
        known = registered_in(settle(home).entries)
        for number in numbers_in(home):
            if number not in known:
                version = read_version(home, number)
                append(home, Entry("registered", number, version.registered, version.by))

    def _do(
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


def _facts(model: Path, facts: Mapping[str, Any] | None) -> dict[str, Any]:
    """What was told, or what the model's folder and its run tell."""
    if facts is None:
        return facts_of(model)
    if not isinstance(facts, Mapping):
        raise SpecError(
            f"facts are {facts!r:.80}, not values by name",
            hint="leave them out: the model and its run tell them",
        )
    return dict(facts)


def _sources(model: Path, facts: Mapping[str, Any]) -> list[Path]:
    """Where a model lies and came from, as far as known."""
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
    """Facts of a model folder.

    A model under `RUN/fit/`, or fitted to one run alone, is of that run, whose recordings' digests
    are in the run.

    Args:
        model: Its folder.
        sources: Recordings it was fitted to, where it is not of a run.

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
    """Path → SHA-256 of recordings: those a finished run has noted, and those named.

    Recordings of several runs have the same names: where another has it, the whole path is told.
    """
    found: dict[str, str] = {}
    for stop in sorted(run.glob("stop*.json")) if run is not None else ():  # one per attempt
        noted = read_json(stop).get("sha256", {})
        found |= {name: digest for name, digest in noted.items() if _is_recording(name)}
    for source in sources:
        if not source.exists():
            raise RegistryError(f"{source} is not there", hint="name the recordings as they are")
        whole = source.is_dir()
        noted = _digests(source, ()) if whole else {source.name: sha256_of(source)}
        for name, digest in noted.items():
            taken = found.get(name, digest) != digest
            found[str((source if whole else source.parent) / name) if taken else name] = digest
    return found


def _is_recording(name: str) -> bool:
    """Also one that a crash has cut off: what is whole in it is learned from."""
    return name.removesuffix(PARTIAL_SUFFIX).endswith(".mcap")


def _run(run: Path | None) -> dict[str, Any] | None:
    if run is None or not (run / "start.json").is_file():
        return None
    start = read_json(run / "start.json")
    keys = ("uid", "started", "operator", "host", "experiment", "robot_name", "seed")
    told = {key: start.get(key) for key in keys} | {"folder": str(run)}
    verdict = run / "verdict.json"
    return told | {"verdict": read_json(verdict) if verdict.is_file() else None}


def _evaluation(model: Path) -> Any:
    """The totals of `evaluation.json`; its tables stay in the file."""
    path = model / EVALUATION_FILE
    if not path.is_file():
        return None
    try:
        held = json.loads(path.read_bytes())
    except ValueError as error:
        raise DataError(f"{path} is no evaluation: {error}", hint="fit the model again") from error
    if not isinstance(held, dict):
        return None
    held_out = held.get("held_out") or {}
    parts = [
        {"source": held_out.get("what", ""), **held_out},
        *({"total": one, **one} for one in held.get("validation") or ()),
    ]
    keys = ("source", "unit", "total", "notes")
    return [{key: part[key] for key in keys if part.get(key)} for part in parts if "total" in part]
