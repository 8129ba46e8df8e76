"""`hil explain` and `hil schema`: meaning of YAML keys and exit codes."""

from collections.abc import Iterator
from typing import Annotated, Any

import typer

from hil.cli.options import JsonFlag
from hil.cli.output import print_json, print_table, say
from hil.core import HilError, SpecError, did_you_mean

EXIT = "exit"
CODES_PAGE = "docs/reference/cli.md, Exit codes"

app = typer.Typer()


@app.command()
def explain(
    words: Annotated[
        list[str],
        typer.Argument(
            metavar="KEY | exit [CODE]",
            help="Key such as excitation.dwell_s or its last part, or `exit` and an exit code.",
            show_default=False,
        ),
    ],
    json: JsonFlag = False,
) -> None:
    """Explain a key of a spec, station, series or schedule, or an exit code."""
    from hil.spec import describe_keys

    if words[0] == EXIT and len(words) <= 2:
        _explain_exit(words[1:], json)
        return
    if len(words) > 1:
        raise SpecError(
            f"expected one key, got {' '.join(words)!r}", hint="hil explain excitation.dwell_s"
        )
    keys = describe_keys(words[0])
    if json:
        print_json({"keys": keys})
        return
    for number, key in enumerate(keys):
        if number:
            typer.echo()
        _print_key(key)


def _print_key(key: dict[str, Any]) -> None:
    kind = f", kind: {key['kind']}" if key["kind"] else ""
    typer.echo(f"{key['path']}  ({key['file']}{kind})")
    say(f"  {key['meaning']}")
    rows = [
        ("unit", key["unit"]),
        ("value", key["allowed"]),
        ("default", key["default"]),
        ("keys", ", ".join(key["keys_below"])),
        ("example", key["example"]),
        ("more", key["documented"]),
    ]
    for name, text in rows:
        if text:
            say(f"  {name:<9}{text}")


def _explain_exit(words: list[str], json: bool) -> None:
    codes = _exit_codes()
    if not words:
        if json:
            print_json({"exit_codes": {str(code): _document(code, codes) for code in codes}})
        else:
            rows = ((str(code), errors[0][1]) for code, errors in codes.items())
            print_table(("exit code", "meaning"), rows)
        return
    code = int(words[0]) if words[0].isdecimal() else -1
    if code not in codes:
        known = ", ".join(map(str, codes))
        raise SpecError(f"unknown exit code {words[0]!r}", hint=f"the exit codes are {known}")
    if json:
        print_json(_document(code, codes))
        return
    for kind, meaning in codes[code]:
        say(f"{code}  {kind}: {meaning}" if kind else f"{code}  {meaning}")
    typer.echo(f"   more: {CODES_PAGE}")


def _document(code: int, codes: dict[int, list[tuple[str, str]]]) -> dict[str, Any]:
    errors = [{"kind": kind, "meaning": meaning} for kind, meaning in codes[code]]
    return {"exit_code": code, "errors": errors, "documented": CODES_PAGE}


def _exit_codes() -> dict[int, list[tuple[str, str]]]:
    """Return the errors that belong to every exit code, with the meaning of each error."""
    codes = {0: [("", "done")], 1: [("", "an internal error, or `hil doctor` detected a problem")]}
    for error in _kinds(HilError):
        meaning = (error.__doc__ or "").partition("\n")[0]
        codes.setdefault(error.exit_code, []).append((error.__name__, meaning))
    codes[130] = [("Stopped", "Stopped by a signal: Ctrl-C, SIGTERM or a lost terminal.")]
    return {code: codes[code] for code in sorted(codes)}


def _kinds(error: type[HilError]) -> Iterator[type[HilError]]:
    for below in error.__subclasses__():
        if below.__module__ == HilError.__module__:  # tests and plug-ins may derive others
            yield below
            yield from _kinds(below)


KINDS = ("experiment", "station", "series", "schedule", "fleet", "map")
"""Kinds of YAML files that have a schema."""


@app.command()
def schema(
    kind: Annotated[str, typer.Argument(help=f"Kind of file: {', '.join(KINDS)}.")] = "experiment",
) -> None:
    """Print the JSON Schema of a spec, station, series, schedule, fleet or map, for editors."""
    if kind not in KINDS:
        raise SpecError(f"no schema for files of kind {kind!r}", hint=did_you_mean(kind, KINDS))
    if kind == "map":
        from hil.importers import map_schema

        print_json(map_schema())
        return
    from hil.spec import schema_of

    print_json(schema_of(kind))
