"""Draw random sentences of the project for a reader to score: clear, needs a second reading, odd.

Usage: python -m tests.house.sentences --seed 7               # twenty of each kind
       python -m tests.house.sentences --all hil/estimators   # every sentence of a folder or file

The reader has no context: the kind and the text are printed, the place below all of them. Decision
records and the changelog are left out: both are history.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import random
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
PRODUCT = ("hil", "drivers/hil_drivers", "mock_robot/hil_mock_robot")
PAGES = ("hil/report", "hil/dashboard", "hil/studies")
KINDS = ("help", "message", "page", "docstring", "docs")
REFUSALS = re.compile(r"(Error|Fault|Stopped|Refused|Interlock|Warning|Finding|Problem)$")
LOGGED = {"warn", "warning", "error", "info", "echo", "secho", "notify"}
FEWEST_WORDS = 4


@dataclass(frozen=True)
class Sentence:
    """A sentence, its kind and where it stands."""

    kind: str
    text: str
    place: str


def modules(under: tuple[str, ...]) -> Iterator[tuple[str, ast.Module]]:
    """Yield the path within the repository and the tree of each module."""
    for folder in under:
        start = ROOT / folder
        for path in [start] if start.is_file() else sorted(start.rglob("*.py")):
            yield path.relative_to(ROOT).as_posix(), ast.parse(path.read_text("utf-8"))


def split(text: str) -> list[str]:
    """Return the sentences of a paragraph that have a few words."""
    flat = " ".join(text.split())
    parts = re.split(r"(?<=[.!?])\s+(?=[A-Z`])", flat)
    return [part for part in parts if len(re.findall(r"[A-Za-z]{2,}", part)) >= FEWEST_WORDS]


def literal(node: ast.expr) -> str:
    """Return the text of a string, with `{name}` for what is filled in; empty for other nodes."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(
            f"{{{ast.unparse(part.value)}}}" if isinstance(part, ast.FormattedValue) else
            literal(part) for part in node.values
        )  # fmt: skip
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return literal(node.left) + literal(node.right)
    return ""


def described(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Yield every docstring with its line: of modules, classes, functions and assignments."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            yield ast.get_docstring(node) or "", getattr(node, "lineno", 1)
        body = getattr(node, "body", None)
        for before, after in pairwise(body if isinstance(body, list) else ()):
            if isinstance(before, ast.Assign | ast.AnnAssign) and isinstance(after, ast.Expr):
                yield inspect.cleandoc(literal(after.value)), after.lineno


def docstrings(under: tuple[str, ...]) -> Iterator[Sentence]:
    """Yield the sentences of docstrings, without examples, tables and section headings."""
    for file, tree in modules(under):
        for text, line in described(tree):
            for paragraph in re.split(r"\n\s*\n|\n(?=\s+\w[\w, ]*: )|\n(?=\s*- )", text):
                if re.search(r">>>|::|```|^\s*\||^\s*===", paragraph, re.MULTILINE):
                    continue
                paragraph = re.sub(
                    r"^(Args|Returns|Raises|Yields|Usage|Note|Source):", "", paragraph
                )
                for sentence in split(re.sub(r"^\s*- ", "", paragraph)):
                    yield Sentence("docstring", sentence, f"{file}:{line}")


def messages(under: tuple[str, ...]) -> Iterator[Sentence]:
    """Yield the texts of errors, warnings and log lines."""
    for file, tree in modules(under):
        for node in ast.walk(tree):
            if not isinstance(node, ast.Call):
                continue
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(
                node.func, "id", "")  # fmt: skip
            if not (REFUSALS.search(name) or name in LOGGED):
                continue
            for argument in [*node.args, *(keyword.value for keyword in node.keywords)]:
                for sentence in split(literal(argument)):
                    yield Sentence("message", sentence, f"{file}:{node.lineno}")


def pages(under: tuple[str, ...]) -> Iterator[Sentence]:
    """Yield the texts of reports, studies and the dashboard: strings that are no docstring."""
    for file, tree in modules(under):
        known = {
            id(node.body[0].value)
            for node in ast.walk(tree)
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
            and node.body and isinstance(node.body[0], ast.Expr)
        }  # fmt: skip
        inside = {
            id(child) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr)
            for child in ast.walk(node) if child is not node
        }  # fmt: skip
        for node in ast.walk(tree):
            if not isinstance(node, ast.Constant | ast.JoinedStr):
                continue
            if id(node) in known or id(node) in inside:
                continue
            text = re.sub(r"<[^>]+>", "", literal(node))
            for sentence in split(text) if re.match(r"\s*[A-Z`{]", text) else ():
                yield Sentence("page", sentence, f"{file}:{node.lineno}")


def help_texts() -> Iterator[Sentence]:
    """Yield the help of every verb, option and argument, and of every key and parameter."""
    for file, tree in modules(PRODUCT):
        for node in ast.walk(tree):
            if isinstance(node, ast.keyword) and node.arg in ("description", "doc"):
                for sentence in split(literal(node.value)):
                    yield Sentence("help", sentence, f"{file}:{node.value.lineno}")
    import typer

    from hil.cli.app import app

    def walk(command: Any, words: str) -> Iterator[Sentence]:
        for sentence in split(command.help or ""):
            yield Sentence("help", sentence, words)
        for parameter in command.params:
            for sentence in split(getattr(parameter, "help", "") or ""):
                yield Sentence("help", sentence, f"{words} {parameter.opts[0]}")
        for name, below in getattr(command, "commands", {}).items():
            yield from walk(below, f"{words} {name}")

    yield from walk(typer.main.get_command(app), "hil")


def documentation(under: tuple[str, ...]) -> Iterator[Sentence]:
    """Yield the sentences of Markdown pages, without code, tables and headings."""
    for folder in under:
        start = ROOT / folder
        for path in [start] if start.is_file() else sorted(start.rglob("*.md")):
            if "decisions" in path.parts:
                continue
            text = re.sub(r"<!--.*?-->", "", path.read_text("utf-8"), flags=re.S)
            text = re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
            text = re.sub(r"^(#.*|\|.*|<.*|!.*|---.*|:::.*)$", "", text, flags=re.M)
            for paragraph in re.split(r"\n\s*\n|\n(?=\s*(?:[-*]|\d+\.) )", text):
                plain = re.sub(r"\[([^\]]+)\]\([^)]+\)", r"\1", paragraph)
                for sentence in split(re.sub(r"^\s*(?:[-*]|\d+\.) ", "", plain)):
                    yield Sentence("docs", sentence, path.relative_to(ROOT).as_posix())


def of_kind(kind: str) -> list[Sentence]:
    """Return all distinct sentences of a kind."""
    found = {
        "help": help_texts,
        "message": lambda: messages(PRODUCT),
        "page": lambda: pages(PAGES),
        "docstring": lambda: docstrings(PRODUCT),
        "docs": lambda: documentation(("README.md", "docs")),
    }[kind]()
    return list({one.text: one for one in found}.values())


def of_place(place: str) -> list[Sentence]:
    """Return all sentences of a file or folder, in the order of their places."""
    under = (place,)
    if place.endswith(".md") or place.startswith("docs"):
        return list(documentation(under))
    parts = [*docstrings(under), *messages(under)]
    if place.startswith(PAGES):
        parts += pages(under)
    return sorted(
        parts, key=lambda one: (one.place.partition(":")[0], int(one.place.split(":")[1]))
    )


def main() -> int:
    """Print the sentences that are asked for."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--each", type=int, default=20, help="sentences of each kind")
    options.add_argument("--all", metavar="PLACE", help="every sentence of a file or folder")
    asked = options.parse_args()
    if asked.all:
        for one in of_place(asked.all):
            sys.stdout.write(f"{one.place} [{one.kind}] {one.text}\n")
        return 0
    dice = random.Random(asked.seed)
    drawn = [one for kind in KINDS for one in dice.sample(of_kind(kind), asked.each)]
    for number, one in enumerate(drawn, 1):
        sys.stdout.write(f"{number}. [{one.kind}] {one.text}\n")
    sys.stdout.write("\nPlaces\n")
    for number, one in enumerate(drawn, 1):
        sys.stdout.write(f"{number}. {one.place}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
