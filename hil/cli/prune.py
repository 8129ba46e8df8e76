"""`hil prune`: delete runs by a policy, none that a registered model came from."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.cli.options import JsonFlag, RunsOption, parse_duration
from hil.cli.output import print_json, print_table, say
from hil.core import RegistryError
from hil.report import size

if TYPE_CHECKING:
    from hil.runs import Decision

app = typer.Typer()


@app.command()
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
    from hil.models import known_registries
    from hil.runs import Policy, decide, leftovers, remove

    age = parse_duration("--older-than", older_than, "--older-than 180d") if older_than else None
    policy = Policy(tuple(query or ()), age, keep, interrupted, recordings_only, older_than)
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
    document = {
        "deleted": yes,
        "policy": policy.to_dict(),
        "registries": [str(one) for one in registries],
        "bytes": sum(one.size for one in decisions if one.goes),
        "runs": [one.to_dict() for one in decisions],
    }
    if json:
        print_json(document)
    else:
        refuses = not registries and not no_registry
        _print(document, decisions, len(left), refuses=refuses)


def _print(
    document: dict[str, Any], decisions: "list[Decision]", left: int, *, refuses: bool
) -> None:
    going = [one for one in decisions if one.goes]
    if going:
        print_table(("goes", "size"), [(str(one.run), size(one.size)) for one in going])
    guarded = [one for one in decisions if one.guarded]
    if guarded:
        print_table(("stays", "because"), [(str(one.run), one.why) for one in guarded])
    others = Counter(one.why for one in decisions if one.why and not one.guarded)
    for why, count in others.items():
        say(f"{count} more {'stays' if count == 1 else 'stay, each'} because {why}")
    if not document["registries"] and not refuses:
        say("no registry is known: no run is kept for the sake of a model")
    what = "the recordings of " if document["policy"]["recordings_only"] else ""
    total = f"{what}{len(going)} run{'s'[: len(going) != 1]}, {size(document['bytes'])}"
    if document["deleted"]:
        say(f"deleted: {total}")
        return
    say(f"would be deleted: {total}; nothing was" + ("" if refuses else ", --yes does it"))
    if refuses:
        say(
            "no registry is known, so --yes will refuse: name one with --registry DIR, or add "
            "--no-registry"
        )
    if left:
        say(f"{left} that an earlier deletion has left half done would go, too")
