"""`hil models`: versions of models, champion and challenger, promotion and rollback."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.cli.options import (
    REGISTRY,
    JsonFlag,
    ModelArgument,
    NameArgument,
    RegistryOption,
    RunsOption,
    SourcesArgument,
)
from hil.cli.output import print_errors, print_json, print_table, say
from hil.core import RegistryError, SpecError, shell_word

if TYPE_CHECKING:
    from hil.models import Aliases, Registry

app = typer.Typer(
    name="models",
    no_args_is_help=True,
    help="Manage registered models: versions, champion and challenger, promotion, rollback.",
)


@app.command("list")
def list_models(registry: RegistryOption = REGISTRY, json: JsonFlag = False) -> None:
    """List model names with their champions and challengers."""
    from hil.models import Registry

    home = Registry(registry)
    rows = []
    for name in home.names():
        roles, problem = _roles(home, name)
        rows.append({"name": name, "versions": len(home.versions(name)), **roles.to_dict(),
                     "problem": problem and problem.message})  # fmt: skip
        _warn(problem)
    if json:
        print_json({"registry": str(registry), "models": rows})
        return
    if not rows:
        say(f"no models in {registry}; register one: hil models register MODEL --name NAME")
        return
    print_table(
        ("name", "versions", "champion", "challenger"),
        [(one["name"], str(one["versions"]),
          "log damaged" if one["problem"] else _label(one["champion"]), _label(one["challenger"]))
         for one in rows],
    )  # fmt: skip


@app.command()
def show(
    name: NameArgument,
    version: Annotated[
        str,
        typer.Argument(help="Version: champion, challenger or a number such as v3; default: all."),
    ] = "",
    registry: RegistryOption = REGISTRY,
    json: JsonFlag = False,
) -> None:
    """List the versions of a model, or show one version in detail."""
    from hil.models import Registry

    home = Registry(registry)
    if version:
        print_json(home.version(name, version).to_dict())
        return
    versions = home.versions(name)
    aliases, problem = _roles(home, name)
    _warn(problem)
    if json:
        document = {"name": name, **aliases.to_dict(), "problem": problem and problem.message}
        print_json({**document, "versions": [one.to_dict() for one in versions]})
        return
    role = {aliases.champion: "champion", aliases.challenger: "challenger"}
    print_table(
        ("version", "role", "estimator", "registered (UTC)", "by", "run"),
        [(one.label, role.get(one.number, ""), str(one.facts.get("estimator", "")),
          one.registered[:16], one.by, _run(one.facts)) for one in versions],
    )  # fmt: skip


@app.command("register")
def register_model(
    model: ModelArgument,
    name: Annotated[
        str,
        typer.Option(
            "--name",
            help="Name of the registered model, such as the name of the robot.",
            show_default=False,
        ),
    ],
    data: Annotated[
        list[str] | None,
        typer.Option(
            "--data",
            help="Recording the model was fitted to, if the model is not part "
            "of a run; repeatable.",
        ),
    ] = None,
    challenger: Annotated[
        bool, typer.Option("--challenger", help="Mark the version as challenger of the champion.")
    ] = False,
    registry: RegistryOption = REGISTRY,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Register a model as a new version. An identical model adds no version."""
    from hil.models import Registry, facts_of
    from hil.runs import find_model, find_source

    home, folder = Registry(registry), find_model(model, runs)
    facts = facts_of(folder, [find_source(one, runs) for one in data or ()])
    version = home.register(name, folder, facts, challenger=challenger)
    if json:
        print_json(version.to_dict())
        return
    typer.echo(f"{name} {version.label}: {version.facts.get('estimator', '')} → {version.folder}")
    if not home.aliases(name).champion:
        typer.echo(f"make it champion: hil models promote {name} {version.label}")


@app.command()
def compare(
    name: NameArgument,
    version: Annotated[str, typer.Argument(help="Version: challenger or a number such as v3.")],
    sources: SourcesArgument,
    against: Annotated[
        str,
        typer.Option("--with", help="Version to compare with: champion or a number such as v2."),
    ] = "champion",
    registry: RegistryOption = REGISTRY,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Compare two versions of a model on recordings that neither version was fitted to."""
    from hil.models import Registry, compare_sources
    from hil.runs import find_source

    home = Registry(registry)
    try:
        old = home.version(name, against)
    except RegistryError as error:
        if against != "champion" or home.aliases(name).champion:
            raise
        hint = (
            "compare with another version: --with v2; or make one the champion: "
            f"hil models promote {name} v1"
        )
        raise RegistryError(error.message, hint=hint) from None
    new = home.version(name, version)
    models = home.load(name, old.label), home.load(name, new.label)
    comparison = compare_sources(*models, [find_source(one, runs) for one in sources]).to_dict()
    if json:
        print_json({"name": name, "champion": old.label, "challenger": new.label, **comparison})
        return
    _print_comparison(comparison, old.label, new.label)


@app.command()
def promote(
    name: NameArgument,
    version: Annotated[
        str, typer.Argument(help="Version: challenger or a number such as v3.")
    ] = "challenger",
    on: Annotated[
        list[str] | None,
        typer.Option("--on", help="Run or MCAP file to compare on; repeatable."),
    ] = None,
    max_rmse: Annotated[
        float | None,
        typer.Option(
            "--max-rmse",
            help="Largest accepted mean RMSE on each recording, unfiltered, in N·m or A.",
        ),
    ] = None,
    unless_worse: Annotated[
        bool,
        typer.Option(
            "--unless-worse", help="Also promote if neither version is significantly better."
        ),
    ] = False,
    reason: Annotated[str, typer.Option("--reason", help="Reason; recorded in the log.")] = "",
    registry: RegistryOption = REGISTRY,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Make a version the champion if it has smaller errors on hold-out recordings.

    The first champion needs no recording, because there is no other version to compare with.
    """
    from hil.evaluation import Criterion
    from hil.models import Registry, challenge, require_promoted
    from hil.runs import find_source

    home = Registry(registry)
    if not on and (max_rmse is not None or home.aliases(name).champion):
        raise SpecError(
            "a recording is required, except for a first champion without --max-rmse",
            hint="pass a recording that neither version was fitted to: --on SOURCE",
        )
    criteria = () if max_rmse is None else (Criterion("rmse_raw", max_rmse),)
    decision = challenge(
        home,
        name,
        version,
        [find_source(one, runs) for one in on or ()],
        criteria=criteria,
        unless_worse=unless_worse,
        reason=reason,
    )
    if json:
        print_json(decision.to_dict())
    elif decision.promoted:
        comparison, before = decision.comparison, decision.instead_of
        if comparison is not None and before is not None:
            _print_comparison(comparison.to_dict(), before.label, decision.version.label)
        typer.echo(f"{name}: {decision.version.label} is champion: {decision.reason}")
    require_promoted(decision)


@app.command()
def rollback(
    name: NameArgument,
    to: Annotated[
        str,
        typer.Option(
            "--to", help="Version to restore, such as v2; default: the previous champion."
        ),
    ] = "",
    reason: Annotated[str, typer.Option("--reason", help="Reason; recorded in the log.")] = "",
    registry: RegistryOption = REGISTRY,
    json: JsonFlag = False,
) -> None:
    """Undo a promotion: make the previous champion the champion again."""
    from hil.models import Registry

    home = Registry(registry)
    number = home.version(name, to).number if to else 0
    aliases = home.roll_back(name, reason=reason, to=number)
    if json:
        print_json({"name": name, **aliases.to_dict()})
    else:
        typer.echo(f"{name}: v{aliases.champion} is champion again")


@app.command()
def log(name: NameArgument, registry: RegistryOption = REGISTRY, json: JsonFlag = False) -> None:
    """Show the history of a model: events, times, users and reasons."""
    from hil.models import Registry

    entries = Registry(registry).log(name)
    if json:
        print_json({"name": name, "log": [entry.to_dict() for entry in entries]})
        return
    print_table(
        ("when (UTC)", "version", "what", "by", "why"),
        [(one.at[:19], one.label, one.event, one.by, one.reason) for one in entries],
    )


@app.command()
def check(registry: RegistryOption = REGISTRY, json: JsonFlag = False) -> None:
    """Verify every file and log of the models by its digest, and rebuild the views.

    The files of a damaged model are not changed.
    """
    from hil.models import Registry

    rows = [
        {"name": name, "versions": len(versions), **aliases.to_dict()}
        for name, (versions, aliases) in Registry(registry).check().items()
    ]
    if json:
        print_json({"registry": str(registry), "models": rows})
    else:
        count = sum(one["versions"] for one in rows)
        typer.echo(
            f"{registry}: {len(rows)} names, {count} versions: all unchanged since registration"
        )


@app.command()
def repair(
    name: NameArgument,
    registry: RegistryOption = REGISTRY,
    json: JsonFlag = False,
) -> None:
    """Rebuild a damaged log from its intact lines and the version folders.

    The old files of a damaged model are copied to a folder damaged-TIME. A log that is intact is
    not changed.
    """
    from hil.models import LOG_FILE, Registry

    home = Registry(registry)
    done = home.repair(name)
    now = home.aliases(name)
    if json:
        print_json({"name": name, "repair": done and done.to_dict(), **now.to_dict()})
        return
    champion = f"champion {_label(now.champion)}" if now.champion else "no champion"
    if done is None:
        typer.echo(f"{name}: the log is intact, nothing to repair; {champion}")
        return
    entered = ", ".join(f"v{number}" for number in done.registered) or "none"
    say(f"{name}: {done.problem}")
    say(f"  intact lines: {done.lines}; versions added from folders: {entered}")
    if done.lines_set_aside:
        old = done.aside / LOG_FILE
        say(f"  damaged lines: {done.lines_set_aside}, not in the new log, only in {old}")
    if done.lost:
        lost = ", ".join(f"v{number}" for number in done.lost)
        say(f"  lost versions, which have no role any more: {lost}")
    say(f"  {champion} (from {done.source}); challenger {_label(now.challenger) or 'none'}")
    say(f"  copies of the old files: {done.aside}")
    if not now.champion:
        why = "there is no champion" if done.lost else "no file names a champion"
        say(f"  {why}: the next promotion is the first, without a comparison")
        if now.before:
            back = f"hil models rollback {name} --registry {shell_word(registry)}"
            say(f"  or make v{now.before[-1]} champion again: {back}")


def _roles(home: "Registry", name: str) -> "tuple[Aliases, RegistryError | None]":
    """Return the roles and the problem of the log; if there is a problem, the roles are unknown."""
    from hil.models import Aliases

    problem = home.problem(name)
    return (Aliases() if problem else home.aliases(name)), problem


def _warn(problem: RegistryError | None) -> None:
    if problem:
        typer.echo(f"warning: {problem.message}\n  next: {problem.hint}", err=True)


def _label(number: int | None) -> str:
    return f"v{number}" if number else ""


def _run(facts: Any) -> str:
    run = facts.get("run") or {}
    return Path(str(run.get("folder", ""))).name


def _print_comparison(comparison: dict[str, Any], champion: str, challenger: str) -> None:
    rows = [(champion, comparison["champion_rmse"]), (challenger, comparison["challenger_rmse"])]
    print_errors(f"RMSE [{comparison['unit']}]", rows, mean=False)
    counts = f"{comparison['blocks']} blocks of time, {comparison['samples']} samples"
    typer.echo(f"{comparison['words']}; {counts}")
