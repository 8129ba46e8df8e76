"""`hil models`: versions of models, who is champion, and the way back."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.cli.models import Sources, found
from hil.cli.output import JsonFlag, RunsOption, print_json, print_table, say
from hil.core import RegistryError, shell_word

if TYPE_CHECKING:
    from hil.models import Aliases, Registry

RegistryOption = Annotated[
    Path,
    typer.Option("--registry", envvar="HIL_REGISTRY", help="Folder of the registered models."),
]
NameArgument = Annotated[str, typer.Argument(help="Name of the models, such as the robot's.")]
HERE = Path("registry")

app = typer.Typer(
    no_args_is_help=True,
    help="Registered models: versions, champion and challenger, promotion and the way back.",
)


def register(parent: typer.Typer) -> None:
    """Add this group's verbs."""
    parent.add_typer(app, name="models")


@app.command("list")
def list_models(registry: RegistryOption = HERE, json: JsonFlag = False) -> None:
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
    registry: RegistryOption = HERE,
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
        listed = [one.to_dict() for one in versions]
        found = {"problem": problem and problem.message, "versions": listed}
        print_json({"name": name, **aliases.to_dict(), **found})
        return
    role = {aliases.champion: "champion", aliases.challenger: "challenger"}
    print_table(
        ("version", "is", "estimator", "registered (UTC)", "by", "of run"),
        [(one.label, role.get(one.number, ""), str(one.facts.get("estimator", "")),
          one.registered[:16], one.by, _run(one.facts)) for one in versions],
    )  # fmt: skip


@app.command("register")
def register_model(
    model: Annotated[Path, typer.Argument(help="Model folder.", show_default=False)],
    name: Annotated[str, typer.Option("--name", help="Name of the models.", show_default=False)],
    data: Annotated[
        list[Path] | None,
        typer.Option("--data", help="Recording it was fitted to, where it is not of a run."),
    ] = None,
    challenger: Annotated[
        bool, typer.Option("--challenger", help="To be compared with the champion.")
    ] = False,
    registry: RegistryOption = HERE,
    json: JsonFlag = False,
) -> None:
    """Add a model as a version; the same model twice is one version."""
    from hil.models import Registry, facts_of

    home = Registry(registry)
    version = home.register(name, model, facts_of(model, data or ()), challenger=challenger)
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
    sources: Sources,
    against: Annotated[str, typer.Option("--with", help="champion or v2.")] = "champion",
    registry: RegistryOption = HERE,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Two versions on the same recordings, which neither was fitted to."""
    from hil.models import Registry, compare_sources

    home = Registry(registry)
    old, new = home.version(name, against), home.version(name, version)
    models = home.load(name, old.label), home.load(name, new.label)
    told = compare_sources(*models, found(sources, runs)).to_dict()
    if json:
        print_json({"name": name, "champion": old.label, "challenger": new.label, **told})
        return
    _print_comparison(told, old.label, new.label)


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
    registry: RegistryOption = HERE,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Make a version champion, if it errs less on recordings that neither was fitted to.

    The first one needs none: there is nothing to compare it with.
    """
    from hil.core import SpecError
    from hil.evaluation import Criterion
    from hil.models import Registry, challenge, require_promoted

    home = Registry(registry)
    if not on and (max_rmse is not None or home.aliases(name).champion):
        raise SpecError(
            "nothing to judge it on: only a first champion without --max-rmse needs no recording",
            hint="name a recording neither was fitted to: --on SOURCE",
        )
    criteria = () if max_rmse is None else (Criterion("rmse_raw", max_rmse),)
    decision = challenge(
        home, name, version, found(on or (), runs),
        criteria=criteria, unless_worse=unless_worse, reason=reason,
    )  # fmt: skip
    if json:
        print_json(decision.to_dict())
    elif decision.promoted:
        told = decision.comparison
        if told is not None and decision.instead_of is not None:
            _print_comparison(told.to_dict(), decision.instead_of.label, decision.version.label)
        typer.echo(f"{name}: {decision.version.label} is champion: {decision.reason}")
    require_promoted(decision)


@app.command()
def rollback(
    name: NameArgument,
    to: Annotated[str, typer.Option("--to", help="v2; by default the champion before.")] = "",
    reason: Annotated[str, typer.Option("--reason", help="For the log.")] = "",
    registry: RegistryOption = HERE,
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
def log(name: NameArgument, registry: RegistryOption = HERE, json: JsonFlag = False) -> None:
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
def check(registry: RegistryOption = HERE, json: JsonFlag = False) -> None:
    """Compare every file with its digest and every log with its head; rebuild the views.

    Nothing is written for a damaged name.
    """
    from hil.models import Registry

    home, problems = Registry(registry), list[RegistryError]()
    rows = []
    for name in home.names():
        try:
            versions = home.versions(name)
            for version in versions:
                version.verify()
            rows.append({"name": name, "versions": len(versions), **home.rebuild(name).to_dict()})
        except RegistryError as error:
            problems.append(error)
    if problems:
        others = "".join(f"; {one.message}" for one in problems[1:])
        raise RegistryError(problems[0].message + others, hint=problems[0].hint) from problems[0]
    if json:
        print_json({"registry": str(registry), "models": rows})
    else:
        count = sum(one["versions"] for one in rows)
        typer.echo(f"{registry}: {len(rows)} names, {count} versions: all as they were registered")


@app.command()
def repair(
    name: NameArgument,
    registry: RegistryOption = HERE,
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


def _print_comparison(told: dict[str, Any], old: str, new: str) -> None:
    joints = [f"J{j + 1}" for j in range(len(told["joint_names"]))]
    rows = [
        (label, *(f"{value:.4f}" for value in told[key]))
        for label, key in ((old, "champion_rmse"), (new, "challenger_rmse"))
    ]
    print_table((f"RMSE [{told['unit']}]", *joints), rows)
    typer.echo(f"{told['words']}; {told['blocks']} blocks of time, {told['samples']} samples")
