"""`hil prune`: delete old runs, except runs that a registered model was fitted to."""

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
            help="Conditions as in `hil runs`; default: all runs.",
            show_default=False,
        ),
    ] = None,
    older_than: Annotated[
        str,
        typer.Option(
            "--older-than", metavar="AGE", help="Only runs older than this, such as 180d."
        ),
    ] = "",
    keep: Annotated[
        int | None,
        typer.Option("--keep", min=1, help="Keep the newest N runs of each robot and experiment."),
    ] = None,
    recordings_only: Annotated[
        bool,
        typer.Option(
            "--recordings-only", help="Delete recordings only; keep documents, models and reports."
        ),
    ] = False,
    interrupted: Annotated[
        bool, typer.Option("--interrupted", help="Also delete interrupted runs.")
    ] = False,
    registry: Annotated[
        list[Path] | None,
        typer.Option(
            "--registry",
            help="Additional registry whose models protect their runs; repeatable. Registries "
            "noted in the runs, $HIL_REGISTRY and folders named `registry` are always used.",
        ),
    ] = None,
    no_registry: Annotated[
        bool, typer.Option("--no-registry", help="Delete even if no registry is found.")
    ] = False,
    yes: Annotated[
        bool,
        typer.Option("--yes", help="Delete the runs; without this option they are only listed."),
    ] = False,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Delete old runs or only their recordings; without --yes, only list what would be deleted."""
    from hil.models import known_registries
    from hil.runs import Policy, decide, leftovers, remove

    age = parse_duration("--older-than", older_than, "--older-than 180d") if older_than else None
    policy = Policy(tuple(query or ()), age, keep, interrupted, recordings_only, older_than)
    registries = known_registries(runs, registry or ())
    if yes and not registries and not no_registry:
        raise RegistryError(
            "no registry was found: runs with registered models would also be deleted",
            hint="pass the registry with --registry DIR; if there is none, pass --no-registry",
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
        print_table(("delete", "size"), [(str(one.run), size(one.size)) for one in going])
    guarded = [one for one in decisions if one.guarded]
    if guarded:
        print_table(("keep", "reason"), [(str(one.run), one.why) for one in guarded])
    others = Counter(one.why for one in decisions if one.why and not one.guarded)
    for why, count in others.items():
        say(f"{count} more {'run is kept' if count == 1 else 'runs are kept, each'} because {why}")
    if not document["registries"] and not refuses:
        say("no registry was found: registered models protect no run")
    what = "the recordings of " if document["policy"]["recordings_only"] else ""
    total = f"{what}{len(going)} run{'s'[: len(going) != 1]}, {size(document['bytes'])}"
    if document["deleted"]:
        say(f"deleted: {total}")
        return
    say(f"would be deleted: {total}; nothing was deleted" + ("" if refuses else " without --yes"))
    if refuses:
        say("no registry was found, so --yes is refused: pass --registry DIR or --no-registry")
    if left:
        say(f"would also be deleted: {left} incompletely deleted earlier")
