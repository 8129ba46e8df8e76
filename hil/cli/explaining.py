"""`hil explain`: what a key of a YAML file means, and what an exit code."""

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.cli.output import JsonFlag, fold, out_width, print_json, print_table
from hil.core import HilError, SpecError

if TYPE_CHECKING:
    from hil.spec import KeyInfo

EXIT = "exit"
EXAMPLE = "hil explain excitation.dwell_s"
CODES_PAGE = "docs/reference/cli.md, Exit codes"


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command()(explain)


def explain(
    words: Annotated[
        list[str],
        typer.Argument(
            metavar="KEY | exit [CODE]",
            help="A key such as excitation.dwell_s, its end, or `exit` and a code.",
            show_default=False,
        ),
    ],
    json: JsonFlag = False,
) -> None:
    """Say what a key of a spec, station, series or schedule means, or an exit code."""
    if words[0] == EXIT and len(words) <= 2:
        _explain_exit(words[1:], json)
        return
    if len(words) > 1:
        raise SpecError(f"{' '.join(words)!r} is more than one key", hint=EXAMPLE)
    found = [_told(info) for info in _keys(words[0])]
    if json:
        print_json({"keys": found})
        return
    for number, told in enumerate(found):
        if number:
            typer.echo()
        _print_key(told)


def _keys(key: str) -> "list[KeyInfo]":
    """What a key means; keys that many mappings share in the same words are told once."""
    from hil.spec import explain_key

    wanted = key.strip().strip(".")
    if "" in wanted.split(".") or wanted.replace(".", "").isdigit():
        raise SpecError(f"{key!r} is no key", hint=EXAMPLE)
    unlike: dict[tuple[str, ...], KeyInfo] = {}
    for info in explain_key(wanted):
        words = (info.file, info.path, info.allowed, info.default, info.meaning)
        unlike[words] = replace(info, kind="") if words in unlike else info
    return list(unlike.values())


def _told(info: "KeyInfo") -> dict[str, Any]:
    from hil.spec import section_of

    below = [one.path.rpartition(".")[2] for one in _below(info)]
    return {
        "file": info.file,
        "path": info.path,
        "kind": info.kind,
        "unit": info.unit,
        "allowed": info.allowed.replace("`", ""),
        "default": info.default.strip("`"),
        "meaning": info.meaning,
        "keys_below": list(dict.fromkeys(below)),
        "example": _example(info),
        "documented": f"docs/reference/spec.md, {info.file.capitalize()}, {section_of(info)}",
    }


def _below(info: "KeyInfo") -> "list[KeyInfo]":
    """The keys of the mapping that a key holds, of all its kinds."""
    from hil.spec import MODELS, keys_below

    known = keys_below(MODELS[info.file])
    above = (info.path, f"{info.path}.<name>")  # entries of a dict have names of their own
    return [replace(one, file=info.file) for one in known if one.path.rpartition(".")[0] in above]


def _example(info: "KeyInfo") -> str:
    """A line with a key; of a mapping with the first of its keys that has one."""
    from hil.spec import example_of

    if given := example_of(info):
        return given
    inside = next((line for one in _below(info) if (line := _example(one))), "")
    if not inside:
        return ""
    form = "[{%s}]" if info.allowed.startswith("list") else "{%s}"
    return f"{info.path.rpartition('.')[2]}: {form % inside}"


def _print_key(told: dict[str, Any]) -> None:
    kind = f", kind: {told['kind']}" if told["kind"] else ""
    typer.echo(f"{told['path']}  ({told['file']}{kind})")
    typer.echo(fold(f"  {told['meaning']}", out_width()))
    rows = [
        ("unit", told["unit"]),
        ("value", told["allowed"]),
        ("default", told["default"]),
        ("keys", ", ".join(told["keys_below"])),
        ("example", told["example"]),
        ("more", told["documented"]),
    ]
    for name, text in rows:
        if text:
            typer.echo(fold(f"  {name:<9}{text}", out_width()))


def _explain_exit(words: list[str], json: bool) -> None:
    codes = _codes()
    if not words:
        if json:
            print_json({"exit_codes": {str(code): _as_json(code, codes) for code in codes}})
            return
        print_table(("exit code", "what"), ((str(c), told[0][1]) for c, told in codes.items()))
        return
    code = int(words[0]) if words[0].isdecimal() else -1
    if code not in codes:
        known = ", ".join(map(str, codes))
        raise SpecError(f"hil never exits with {words[0]!r}", hint=f"exit codes are {known}")
    if json:
        print_json(_as_json(code, codes))
        return
    for kind, meaning in codes[code]:
        typer.echo(
            fold(f"{code}  {kind}: {meaning}" if kind else f"{code}  {meaning}", out_width())
        )
    typer.echo(f"   more: {CODES_PAGE}")


def _as_json(code: int, codes: dict[int, list[tuple[str, str]]]) -> dict[str, Any]:
    errors = [{"kind": kind, "meaning": meaning} for kind, meaning in codes[code]]
    return {"exit_code": code, "errors": errors, "documented": CODES_PAGE}


def _codes() -> dict[int, list[tuple[str, str]]]:
    """Every exit code with the errors that have it, and what they mean."""
    codes = {0: [("", "done")]}
    for error in _kinds(HilError):
        meaning = (error.__doc__ or "").partition("\n")[0]
        codes.setdefault(error.exit_code, []).append((error.__name__, meaning))
    codes[130] = [("Stopped", "Stopped by a signal: Ctrl-C, SIGTERM or a lost terminal.")]
    return {code: codes[code] for code in sorted(codes)}


def _kinds(error: type[HilError]) -> Iterator[type[HilError]]:
    for below in error.__subclasses__():
        if below.__module__ == HilError.__module__:
            yield below
            yield from _kinds(below)
