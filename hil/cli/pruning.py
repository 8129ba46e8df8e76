"""`hil prune`: runs let go by a policy; those that registered models came from never."""

import os
from collections import Counter
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.cli.output import JsonFlag, RunsOption, print_json, print_table, say, size
from hil.core import RegistryError, SpecError

if TYPE_CHECKING:
    from hil.runs import Decision

HERE = Path("registry")


def register(app: typer.Typer) -> None:
    """Add this group's verb."""
    app.command()(prune)


def prune(
    query: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[QUERY]...",
            help="Only runs that meet it, as of `hil runs`; by default whatever they are.",
            show_default=False,
        ),
    ] = None,
    older_than: Annotated[
        str, typer.Option("--older-than", metavar="AGE", help="Started longer ago, such as 180d.")
    ] = "",
    keep: Annotated[
        int | None,
        typer.Option(
            "--keep", min=1, help="All but the newest so many of each robot and experiment."
        ),
    ] = None,
    recordings_only: Annotated[
        bool, typer.Option("--recordings-only", help="Documents, models and reports stay.")
    ] = False,
    interrupted: Annotated[
        bool, typer.Option("--interrupted", help="Also runs that were interrupted.")
    ] = False,
    registry: Annotated[
        list[Path] | None,
        typer.Option(
            "--registry",
            help="Folder of registered models beside those noted in the runs, $HIL_REGISTRY, "
            "`registry` here and beside the runs. Repeatable.",
        ),
    ] = None,
    no_registry: Annotated[
        bool, typer.Option("--no-registry", help="Delete although no registry is known.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Delete; otherwise it is only said.")] = False,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Delete old runs, none that a registered model came from; says only which without --yes."""
    from hil.runs import Policy, decide, leftovers, remove

    policy = Policy(tuple(query or ()), _age(older_than), keep, interrupted, recordings_only,
                    older_than)  # fmt: skip
    registries = known_registries(runs, registry or ())
    if yes and not registries and not no_registry:
        raise RegistryError(
            "no registry is known: runs that models came from would go",
            hint="name it with --registry DIR; if there is none: --no-registry",
        )
    decisions = decide(runs, policy, registries)
    left = leftovers(runs)
    if yes:
        decisions = remove(decisions, runs, policy, registries)
    told = {
        "deleted": yes,
        "policy": policy.to_dict(),
        "registries": [str(one) for one in registries],
        "bytes": sum(one.size for one in decisions if one.goes),
        "runs": [one.to_dict() for one in decisions],
    }
    if json:
        print_json(told)
    else:
        _print(told, decisions, len(left))


def known_registries(runs: Path, named: list[Path] | tuple[Path, ...]) -> list[Path]:
    """Those that are named or noted in the runs, which must be there, and the usual ones that are.

    Raises:
        RegistryError: One that is noted is not there.
    """
    from hil.models import registries_of

    given = [*named, *([Path(told)] if (told := os.environ.get("HIL_REGISTRY")) else [])]
    usual = [place for place in (HERE, runs.resolve().parent / HERE) if place.exists()]
    return list({one.resolve(): one for one in (*usual, *given, *registries_of(runs))}.values())


def _age(text: str) -> timedelta | None:
    from hil.core import duration_of

    try:
        return duration_of(text) if text else None
    except ValueError as error:
        raise SpecError(f"--older-than {error}", hint="for example: --older-than 180d") from None


def _print(told: dict[str, Any], decisions: "list[Decision]", left: int) -> None:
    gone = [one for one in decisions if one.goes]
    if gone:
        print_table(("goes", "size"), [(str(one.run), size(one.size)) for one in gone])
    guarded = [one for one in decisions if one.guarded]
    if guarded:
        print_table(("stays", "because"), [(str(one.run), one.why) for one in guarded])
    others = Counter(one.why for one in decisions if one.why and not one.guarded)
    for why, count in others.items():
        say(f"{count} more {'stays' if count == 1 else 'stay, each'} because {why}")
    if not told["registries"]:
        say("no registry is known: no run is kept for the sake of a model, --yes asks which")
    what = "the recordings of " if told["policy"]["recordings_only"] else ""
    total = f"{what}{len(gone)} run{'s'[: len(gone) != 1]}, {size(told['bytes'])}"
    if told["deleted"]:
        say(f"deleted: {total}")
        return
    say(f"would be deleted: {total}; nothing was, --yes does it")
    if left:
        say(f"{left} that an earlier deletion has left half done would go, too")
