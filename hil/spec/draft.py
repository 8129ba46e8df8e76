"""Drafts of specs, stations and schedules, as a starting point for users (`hil new`)."""

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
"""Name of the folder for schemas beside the written files.

A relative path to the schema works with every editor, in every checkout, without a network, and
independently of the installation path of hil.
"""

DRAFT_KINDS = {
    "dwell": "gravity and static friction from dwells at many poses",
    "fourier": "rigid body and friction from periodic trajectories",
    "load-sweep": "a model of the bare arm, evaluated under loads of known mass",
    "re-identify": "a schedule with probe and campaign, with short intervals for the mock",
    "own-urdf": "a custom arm from its URDF (--urdf): description, station and first spec",
    "station": "a bench: robots, their drivers and their surroundings",
}
"""Kinds of drafts that `hil new` offers, with their descriptions."""


@dataclass(frozen=True, slots=True)
class Draft:
    """Text of a file that is not written yet."""

    path: Path
    text: str


def drafts(kind: str, file: Path, *, robot: str, name: str, model: str = "") -> list[Draft]:
    """Return the draft files of a kind; the next commands take the first file as argument.

    Args:
        kind: Kind of draft in `DRAFT_KINDS`, except `own-urdf`.
        file: Path of the first file; the other files are in the same folder, and their names begin
            with the name of the first file.
        robot: Name of the station's robot for which the files are created.
        name: Name of the experiment, station or schedule in the draft.
        model: Built-in arm of the station's robot; by default the value of `robot`.
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
    """Return a template with replaced words and generated comments."""
    text = files("hil.spec").joinpath(f"templates/{template}.yaml").read_text("utf-8")
    text = "\n".join(_filled(line, words) for line in text.splitlines()) + "\n"
    [(schema, model)] = _kinds_of(text)
    head = f"# yaml-language-server: $schema={SCHEMA_FOLDER}/{schema}.schema.json\n#\n"
    return head + commented(text, model)


_TEXT = re.compile(
    r"(?P<before> *(\w+: (?![\[{]))?)(?P<text>(?! *(\w+: |- ))[^#]*@\w+@.*?)(?P<after>:?(  #.*)?)"
)
"""Pattern of a template line whose value or key contains words to replace; lists contain
numbers."""

_WORD = re.compile(r"@(\w+)@")


def _filled(line: str, words: dict[str, str]) -> str:
    """Return a template line with replaced words; replaced names remain text in YAML."""
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
    """Return the name of the schema and the model of a file by the first key of the file.

    The return values are empty for the description of an arm.
    """
    return [kind for key, kind in _MODELS.items() if f"\n{key}: 1\n" in text]


def require_valid(drafts: list[Draft]) -> None:
    """Raise if a draft is not valid; descriptions of arms are not checked.

    Raises:
        SpecError: A draft is not valid; the message lists all problems of the first invalid draft.
    """
    for draft in drafts:
        for _, model in _kinds_of(draft.text):
            validated(parse(draft.text, str(draft.path)), model)


def schemas_beside(drafts: list[Draft]) -> list[Draft]:
    """Return the schema files that are named in the first lines of drafts."""
    texts = schema_files()
    named = dict.fromkeys(
        (draft.path.parent / SCHEMA_FOLDER / file, file)
        for draft in drafts
        for file in texts
        if f"$schema={SCHEMA_FOLDER}/{file}\n" in draft.text
    )
    return [Draft(path, texts[file]) for path, file in named]
