"""First versions of specs, stations and schedules, for people to go on from."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from hil.core import as_scalar, parse, shown
from hil.spec.documentation import commented, schema_files
from hil.spec.experiment import ExperimentSpec
from hil.spec.field_types import Strict
from hil.spec.load import validated
from hil.spec.schedule import ScheduleSpec
from hil.spec.station import Station

SCHEMA_FOLDER = "schema"
"""Beside what is written: a relative path works with every editor, in every checkout, without a
network, wherever hil is installed."""

DRAFT_KINDS = {
    "dwell": "gravity and static friction from poses at rest",
    "fourier": "rigid body and friction from periodic trajectories",
    "load-sweep": "a model of the bare arm under loads of known mass",
    "re-identify": "a schedule with its probe and its campaign, in minutes, to try on the mock",
    "own-urdf": "your own arm from its URDF (--urdf): its description, a station, a first spec",
    "station": "a bench: robots, their drivers, what stands around them",
}
"""What `hil new` can begin, and what each is."""


@dataclass(frozen=True, slots=True)
class Draft:
    """A file that is yet to be written."""

    path: Path
    text: str


def drafts(kind: str, file: Path, *, robot: str, name: str, model: str = "") -> list[Draft]:
    """The files of a kind, the one that commands are given first.

    Args:
        kind: One of `DRAFT_KINDS`, but for `own-urdf`.
        file: Where the first one goes; others stand beside it and begin with its name.
        robot: A robot of the station that they are for.
        name: What the experiment, station or schedule is called.
        model: Built-in arm of a station's robot; by default what the robot is called.
    """
    words = {"robot": robot, "name": name, "file": str(file), "model": model or robot}
    if kind != "re-identify":
        return [Draft(file, render(kind, words))]
    parts = {part: file.with_name(f"{file.stem}-{part}.yaml") for part in ("probe", "campaign")}
    words |= {part: path.name for part, path in parts.items()}
    words["wear"] = ", ".join(["1", "1.15", *["1"] * 4])
    others = [Draft(path, render(f"{kind}.{part}", words)) for part, path in parts.items()]
    return [Draft(file, render(kind, words)), *others]


def render(template: str, words: dict[str, str]) -> str:
    """A template with its words filled in and its comments made."""
    text = files("hil.spec").joinpath(f"templates/{template}.yaml").read_text("utf-8")
    text = "\n".join(_filled(line, words) for line in text.splitlines()) + "\n"
    [(schema, model)] = _kinds_of(text)
    head = f"# yaml-language-server: $schema={SCHEMA_FOLDER}/{schema}.schema.json\n#\n"
    return head + commented(text, model)


_TEXT = re.compile(
    r"(?P<before> *(\w+: (?![\[{]))?)(?P<text>(?! *(\w+: |- ))[^#]*@\w+@.*?)(?P<after>:?(  #.*)?)"
)
"""A line whose value, or whose key, is made of words; lists have numbers."""

_WORD = re.compile(r"@(\w+)@")


def _filled(line: str, words: dict[str, str]) -> str:
    """A line of a template; what people named things stays text, whatever YAML takes it for."""
    found = _TEXT.fullmatch(line)
    if found is None:
        return _put(line, words)
    text = as_scalar(_WORD.sub(lambda word: words[word[1]], found["text"]))
    return found["before"] + text + _put(found["after"], words)


def _put(line: str, words: dict[str, str]) -> str:
    return _WORD.sub(lambda word: shown(words[word[1]], 300), line)


_MODELS: dict[str, tuple[str, type[Strict]]] = {
    "hil": ("experiment", ExperimentSpec),
    "hil_station": ("station", Station),
    "hil_schedule": ("schedule", ScheduleSpec),
}


def _kinds_of(text: str) -> list[tuple[str, type[Strict]]]:
    """Name of the schema and model of a file by the key it begins with; of an arm none."""
    return [kind for key, kind in _MODELS.items() if f"\n{key}: 1\n" in text]


def require_valid(drafts: list[Draft]) -> None:
    """Refuse drafts that no command would take; descriptions of arms are not looked at.

    Raises:
        SpecError: With all that is wrong with the first such draft.
    """
    for draft in drafts:
        for _, model in _kinds_of(draft.text):
            validated(parse(draft.text, str(draft.path)), model)


def schemas_beside(drafts: list[Draft]) -> list[Draft]:
    """The schema files that the first lines of drafts name."""
    texts = schema_files()
    named = dict.fromkeys(
        (draft.path.parent / SCHEMA_FOLDER / file, file)
        for draft in drafts
        for file in texts
        if f"$schema={SCHEMA_FOLDER}/{file}\n" in draft.text
    )
    return [Draft(path, texts[file]) for path, file in named]
