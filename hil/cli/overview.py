"""`hil` without a command: the commands that are useful next in the current folder."""

import os
from pathlib import Path
from typing import TYPE_CHECKING

from hil.cli.completion import begins_with
from hil.cli.output import print_table
from hil.core import shell_word

if TYPE_CHECKING:
    from hil.runs import RunListing

MOST_SPECS = 3
"""Maximum number of specs that the overview lists."""

SPEC_FOLDERS = (Path(), Path("specs"), Path("experiments"))
"""Folders below the current folder in which the overview searches for specs."""

START = (
    ("hil new dwell", "create a spec for static friction and gravity"),
    ("hil new fourier", "create a spec with periodic trajectories for the complete dynamics"),
    ("hil new --list", "list all other templates"),
)


def print_overview() -> None:
    """Print active and unfinished runs, the newest run, specs, and a command for each."""
    runs = Path(os.environ.get("HIL_RUNS", "runs"))
    rows = [*_about_runs(runs), *_about_specs()]
    rows += [
        ("hil serve", "open the dashboard in a browser"),
        ("hil --help", "list all commands"),
    ]
    print_table(("command", "purpose"), rows)


def _about_runs(runs: Path) -> list[tuple[str, str]]:
    """Return commands for active runs, the newest unfinished run and the newest run."""
    from hil.runs import next_command, run_listings

    listings = run_listings(runs) if runs.is_dir() else []
    rows = [
        (f"hil watch {shell_word(run.path)}", f"follow the active run {run.path.name}")
        for run in listings
        if run.status == "running"
    ]
    ended = [run for run in listings if run.status != "running"]
    unfinished = ((next_command(run), run) for run in reversed(ended))
    if unfinished_run := next(((command, run) for command, run in unfinished if command), None):
        command, run = unfinished_run
        rows.append((command, f"complete {_run_words(run)}"))
    if ended:
        rows.append((f"hil show {shell_word(ended[-1].path)}", f"show {_run_words(ended[-1])}"))
        rows.append(("hil runs", f"list all {len(listings)} runs"))
    return rows


def _run_words(run: "RunListing") -> str:
    return f"the run {run.path.name} ({run.status})"


def _about_specs() -> list[tuple[str, str]]:
    """Return commands for the first specs of this folder, or for new specs if there are none."""
    files = [path for folder in SPEC_FOLDERS for path in sorted(folder.glob("*.yaml"))]
    specs = [path for path in files if begins_with(path, ("hil:",))]
    if not specs:
        return list(START)
    rows = [(f"hil plan {shell_word(specs[0])}", "show the plan of this spec; nothing moves")]
    rows += [(f"hil run {shell_word(path)}", "run this spec") for path in specs[:MOST_SPECS]]
    if (others := len(specs) - MOST_SPECS) > 0:
        rows[-1] = (rows[-1][0], f"run this spec; {others} others are in {specs[-1].parent}/")
    return rows
