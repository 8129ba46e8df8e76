"""Once a week, from cron: probe a robot, and identify it anew when it has changed.

    python experiments/scripts/weekly_reidentification.py experiments/reidentify_weekly.yaml

cron mails what is printed: one line when nothing has changed, the errors of both models besides
when something has. Stages and progress go to standard error. Exit codes: 0 nothing changed, or the
new model is champion; 10 something changed and no better model came of it: somebody has to look;
else those of `hil` (3 a check before motion failed, 4 the robot, 5 an interlock, …). What was cut
off is gone on with the next time.
"""

from __future__ import annotations

import sys
from contextlib import chdir
from pathlib import Path
from typing import Annotated, Any

import typer

import hil
from hil.core import HilError

LOOK = 10


def letter(told: dict[str, Any]) -> list[str]:
    """Return the lines of a mail; the first is its subject."""
    lines = [f"{told['name']}: {told['text']}"]
    if told["outcome"] == "quiet":
        return lines
    lines += ["", f"outcome: {told['outcome']}, champion: {told['champion'] or 'none'}"]
    if errors := told["errors"]:
        lines.append(f"RMSE on probes [{errors['unit']}], a column per joint:")
        for when, version in (("before", told["before"]), ("after", told["champion"])):
            row = "  ".join(f"{value:.4f}" for value in errors[when])
            lines.append(f"  {when:7}{version or 'none':5}{row}")
    lines += [f"{stage}: {Path(run).name}" for stage, run in told["runs"].items()]
    if told["outcome"] == "promoted" and told["before"]:
        lines.append(f"the way back: hil models rollback {told['name']}")
    return lines


def main(
    schedule: Annotated[Path, typer.Argument(help="Schedule (YAML).")],
    station: Annotated[Path | None, typer.Option(help="In place of the one it names.")] = None,
    home: Annotated[Path, typer.Option(help="Folder for runs, registry and state.")] = Path(),
) -> None:
    """Probe, decide, identify anew, promote; print what came of it."""
    try:
        home.mkdir(parents=True, exist_ok=True)
        file, own = schedule.absolute(), station.absolute() if station else None
        with chdir(home):  # all folders are where `hil run` and `hil schedule` have them there
            told = hil.reidentify(file, station=own, tell=lambda text: print(text, file=sys.stderr))
    except (HilError, OSError) as error:
        print(f"{schedule.stem}: FAILED: {error}")
        raise typer.Exit(error.exit_code if isinstance(error, HilError) else 7) from error
    print("\n".join(letter(told)))
    raise typer.Exit(0 if told["outcome"] in ("quiet", "promoted") else LOOK)


if __name__ == "__main__":
    app = typer.Typer(context_settings={"help_option_names": ["-h", "--help"]})
    app.command()(main)
    app()
