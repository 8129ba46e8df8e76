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
    help="Registered models: versions, champion and challenger, promotion and the way back.",
)


@app.command("list")
def list_models(registry: RegistryOption = REGISTRY, json: JsonFlag = False) -> None:
    """Names, their champions and challengers."""
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
        str, typer.Argument(help="champion, challenger or v3; by default all.")
    ] = "",
    registry: RegistryOption = REGISTRY,
    json: JsonFlag = False,
) -> None:
    """Versions of a name, or all that is known of one."""
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
        ("version", "is", "estimator", "registered (UTC)", "by", "of run"),
        [(one.label, role.get(one.number, ""), str(one.facts.get("estimator", "")),
          one.registered[:16], one.by, _run(one.facts)) for one in versions],
    )  # fmt: skip


@app.command("register")
def register_model(
    model: ModelArgument,
    name: Annotated[str, typer.Option("--name", help="Name of the models.", show_default=False)],
    data: Annotated[
        list[str] | None,
        typer.Option("--data", help="Recording it was fitted to, where it is not of a run."),
    ] = None,
    challenger: Annotated[
        bool, typer.Option("--challenger", help="To be compared with the champion.")
    ] = False,
    registry: RegistryOption = REGISTRY,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Add a model as a version; the same model twice is one version."""
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
    version: Annotated[str, typer.Argument(help="challenger or v3.")],
    sources: SourcesArgument,
    against: Annotated[str, typer.Option("--with", help="champion or v2.")] = "champion",
    registry: RegistryOption = REGISTRY,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Two versions on the same recordings, which neither was fitted to."""
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
    version: Annotated[str, typer.Argument(help="challenger or v3.")] = "challenger",
    on: Annotated[
        list[str] | None,
        typer.Option("--on", help="Run or MCAP file to compare on; repeat for several."),
    ] = None,
    max_rmse: Annotated[
        float | None,
        typer.Option("--max-rmse", help="Largest mean RMSE (raw) on each, in the data's unit."),
    ] = None,
    unless_worse: Annotated[
        bool, typer.Option("--unless-worse", help="Also where neither errs less for sure.")
    ] = False,
    reason: Annotated[str, typer.Option("--reason", help="For the log.")] = "",
    registry: RegistryOption = REGISTRY,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Make a version champion, if it errs less on recordings that neither was fitted to.

    The first one needs none: there is nothing to compare it with.
    """
    from hil.evaluation import Criterion
    from hil.models import Registry, challenge, require_promoted
    from hil.runs import find_source

    home = Registry(registry)
    if not on and (max_rmse is not None or home.aliases(name).champion):
        raise SpecError(
            "nothing to judge it on: only a first champion without --max-rmse needs no recording",
            hint="name a recording neither was fitted to: --on SOURCE",
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
    to: Annotated[str, typer.Option("--to", help="v2; by default the champion before.")] = "",
    reason: Annotated[str, typer.Option("--reason", help="For the log.")] = "",
    registry: RegistryOption = REGISTRY,
    json: JsonFlag = False,
) -> None:
    """Make the champion before the present one champion again."""
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
    """What was done to a name's versions, when, by whom and why."""
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
    """Compare every file with its digest and every log with its head; rebuild the views.

    Nothing is written for a damaged name.
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
        typer.echo(f"{registry}: {len(rows)} names, {count} versions: all as they were registered")


@app.command()
def repair(
    name: NameArgument,
    registry: RegistryOption = REGISTRY,
    json: JsonFlag = False,
) -> None:
    """Rebuild a damaged log from its intact lines and the version folders.

    Copies of the old files stay beside it, in a folder damaged-TIME. A sound log is not changed.
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
        typer.echo(f"{name}: the log is sound, nothing to repair; {champion}")
        return
    entered = ", ".join(f"v{number}" for number in done.registered) or "none"
    say(f"{name}: {done.problem}")
    say(f"  intact lines: {done.lines}; versions added from folders: {entered}")
    if done.lines_set_aside:
        old = done.aside / LOG_FILE
        say(f"  lines set aside: {done.lines_set_aside}, not in the new log, only in {old}")
    if done.lost:
        lost = ", ".join(f"v{number}" for number in done.lost)
        say(f"  versions lost, without a role from here on: {lost}")
    say(f"  {champion} (from {done.source}); challenger {_label(now.challenger) or 'none'}")
    say(f"  copies of the old files: {done.aside}")
    if not now.champion:
        why = "there is no champion" if done.lost else "no file names a champion"
        say(f"  {why}: the next promotion is the first, without a comparison")
        if now.before:
            back = f"hil models rollback {name} --registry {shell_word(registry)}"
            say(f"  or make v{now.before[-1]} champion again: {back}")


def _roles(home: "Registry", name: str) -> "tuple[Aliases, RegistryError | None]":
    """Return the roles and the problem of the log; with a problem the roles are unknown."""
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
