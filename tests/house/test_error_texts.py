"""Error texts as a set: what happened and where, in one style, and what to do about it."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from tests.support.paths import ROOT

FOLDERS = ("hil", "drivers/hil_drivers", "mock_robot/hil_mock_robot")
KINDS = {
    node.name
    for node in ast.parse((ROOT / "hil" / "core" / "errors.py").read_text("utf-8")).body
    if isinstance(node, ast.ClassDef)
}

ANSWERS = "mock_robot/hil_mock_robot/ur/"
"""What the mock controller says to a program of URScript: a controller gives no hints either."""

WITHOUT_HINT = 106
"""Errors that say what is wrong and leave what to do to the reader: "patience is 0, but must be a
whole number". Fewer are better: mend one, then lower this."""

NAMES = ("Dask", "Parquet", "True", "URDF", "CAN")
"""What a sentence of ours may begin with in capitals."""


@dataclass(frozen=True)
class Text:
    place: str
    kind: str
    message: str
    hint: str | None


def text_of(node: ast.expr) -> str:
    """A text, with `…` where something is put in."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(text_of(v) if isinstance(v, ast.Constant) else "…" for v in node.values)
    return "…"


def texts_in(source: str, name: str) -> Iterator[Text]:
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.args:
            if node.func.id not in KINDS:
                continue
            hints = [k.value for k in node.keywords if k.arg == "hint"]
            handed_on = any(k.arg is None for k in node.keywords)
            hint = text_of(hints[0]) if hints else "…" if handed_on else None
            yield Text(f"{name}:{node.lineno}", node.func.id, text_of(node.args[0]), hint)


def all_texts() -> list[Text]:
    files = [file for folder in FOLDERS for file in sorted((ROOT / folder).rglob("*.py"))]
    return [
        text
        for file in files
        for text in texts_in(file.read_text("utf-8"), file.relative_to(ROOT).as_posix())
    ]


TEXTS = all_texts()


EXTRA = r"""pip install "hil\[|update hil \(pip install --upgrade hil\)|…"""
"""How hints say what to install; works in the shells of Linux and Windows."""


def faults_of(text: Text) -> list[str]:
    """What is wrong with the style of a text."""
    found = []
    for what, said in (("message", text.message), ("hint", text.hint or "")):
        if said.endswith(".") and not said.endswith(("..", " .")):
            found.append(f"{what} ends with a full stop")
        if re.match("[A-Z][a-z]", said) and not said.startswith(NAMES):
            found.append(f"{what} begins with a capital")
        if said != said.strip():
            found.append(f"{what} has blanks around it")
        if re.search(r"(?i)\b(sorry|oops|invalid input|unknown error)\b", said):
            found.append(f"{what} says nothing")
    if "pip install" in (hint := text.hint or "") and not re.match(EXTRA, hint):
        found.append("the hint names no extra as all others do")
    if text.hint is not None and text.hint != "…" and text.hint == text.message:
        found.append("the hint says what the message says")
    return found


def test_there_are_texts() -> None:
    assert len(TEXTS) > 900
    assert {text.kind for text in TEXTS} >= {"SpecError", "RobotFault", "DataError", "FitError"}


def test_all_texts_have_one_style() -> None:
    told = [f"{text.place}: {fault}" for text in TEXTS for fault in faults_of(text)]
    assert told == []


def test_no_more_errors_than_before_leave_open_what_to_do() -> None:
    without = [t for t in TEXTS if t.hint is None and not t.place.startswith(ANSWERS)]
    told = "\n".join(f"{t.place} {t.kind}: {t.message}" for t in without)
    assert len(without) <= WITHOUT_HINT, f"give the new one a hint:\n{told}"


@pytest.mark.parametrize(
    ("source", "fault"),
    [
        ("DataError('it is gone.')", "ends with a full stop"),
        ("DataError('It is gone')", "begins with a capital"),
        ("DataError(f'{x} is gone', hint='Look.')", "hint ends with a full stop"),
        ("SpecError('sorry, no')", "says nothing"),
        ('PluginError("needs a", hint="pip install \'hil[a]\'")', "names no extra as all others"),
        ("SpecError('look there', hint='look there')", "says what the message says"),
    ],
)
def test_a_text_of_another_style_is_found(source: str, fault: str) -> None:
    (text,) = texts_in(source, "file.py")
    assert fault in "; ".join(faults_of(text))
