"""What differs between two arms of a station? The same program on both, a model of each, a page.

    python experiments/scripts/compare_arms.py ur5-001 ur5-017

Runs and the page, `compared.html`, go into the folder `compared`, or that of `--out`.
What is called different is so with 99 % for all parameters together, by the standard errors of
both. Drive gains are taken as declared: one that is wrong by 3 % scales its joint's parameters.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from html import escape
from pathlib import Path
from statistics import NormalDist
from typing import Annotated, Any

import numpy as np
import typer

import hil
from hil.core import DataError, HilError, SpecError, card, number
from hil.estimators import load_model_file

SURE = 0.99
TELLING = ("rigid-wls", "rigid-linear", "rigid-lmi", "rigid-irls", "rigid-diffnea")
FIT = f"run trajectories, and fit one of {', '.join(TELLING)} (by ols or wls)"
HEAD = (
    "<!doctype html><html lang='en'><meta charset='utf-8'><title>{}</title>"
    "<style>:root{{color-scheme:light dark}}</style>"
)
Row = tuple[str, str, float, float, float, float]
"""Name, unit, value of either arm, standard error of the difference, how many of those."""


@dataclass(frozen=True)
class Arm:
    """An arm, its parameters, and RMS of its friction along the program [N·m]."""

    name: str
    parameters: list[dict[str, Any]]
    friction: dict[str, float]


def program(name: str, spec: Path, station: Path) -> hil.Experiment:
    """Return the experiment of one arm: the spec with another robot."""
    found = hil.load(spec, station, overrides={"robot": json.dumps(name)})
    fits = found.spec.fit
    if len(fits) != 1 or not all(tells_errors(one.estimator, one.parameters) for one in fits):
        raise SpecError(f"{spec} does not fit one model with standard errors", hint=FIT)
    return found


def tells_errors(estimator: str, parameters: dict[str, Any]) -> bool:
    """Whether it fits friction in motion, and parameters that are exported with standard errors."""
    return estimator in TELLING and parameters.get("method", "wls") in ("ols", "wls")


def measure(name: str, experiment: hil.Experiment, out: Path) -> Arm:
    """Run the program on one arm and fit it."""
    report = hil.run(experiment, runs=out / "runs", robot=name)  # the caller has named the arm
    if report.error is not None:
        raise report.error
    document = out / f"{name}.json"
    document.unlink(missing_ok=True)
    hil.export_model(report.models[0], document, to="json")
    model, data = load_model_file(report.models[0]), hil.dataset(report.run).of_kind("trajectory")
    friction = model.predict(data).components.get("friction") if len(data) else None
    if friction is None:
        raise DataError(f"{report.run}: no friction in motion is known", hint=FIT)
    torque = friction * model.torque_scale_
    rms = np.sqrt(np.nanmean(torque**2, axis=0)).tolist()
    parameters = json.loads(document.read_text("utf-8"))["parameters"]
    return Arm(name, parameters, dict(zip(model.joint_names_, rms, strict=True)))


def compared(a: Arm, b: Arm) -> list[Row]:
    """Parameters of both that have standard errors, those most of them apart first."""
    if a.friction.keys() != b.friction.keys():
        raise DataError(f"{a.name} and {b.name} have other joints", hint="compare arms of a kind")
    second = {q["name"]: q for q in b.parameters}
    rows = [
        (p["name"], p["unit"], p["value"], q["value"], std, (q["value"] - p["value"]) / std)
        for p in a.parameters
        if p["std"] and (q := second.get(p["name"])) and q["std"]
        for std in [math.hypot(p["std"], q["std"])]
    ]
    if not rows:
        raise DataError("no parameter of both arms has a standard error", hint=FIT)
    return sorted(rows, key=lambda row: -abs(row[5]))


def more(a: float, b: float) -> str:
    """How much more than the first the second is."""
    return f"{b / a - 1:+.0%}" if a else ""


def page(a: Arm, b: Arm, rows: list[Row], counted: str) -> str:
    """HTML, with the friction of every joint first."""
    joints = [
        (joint, number(nm), number(b.friction[joint]), more(nm, b.friction[joint]))
        for joint, nm in a.friction.items()
    ]
    told = [(n, u, number(x), number(y), number(s), f"{z:+.1f}") for n, u, x, y, s, z in rows]
    head = ("parameter", "unit", a.name, b.name, "± of the difference", "standard errors apart")
    friction = (("RMS friction [N·m]", a.name, b.name, f"{b.name} has"), joints)
    title = f"{a.name} and {b.name}"
    note = ["drive gains are taken as declared"]
    below = card("Parameters", counted, {}, table=(head, told), most=len(told), notes=note)
    return HEAD.format(escape(title)) + card("Two arms", title, {}, table=friction) + below


def compare(first: str, second: str, spec: Path, station: Path, out: Path) -> None:
    """Run both arms, print what differs, and write the page."""
    if first == second:
        raise SpecError(f"{first} twice", hint="name two arms")
    programs = [program(name, spec, station) for name in (first, second)]  # before any arm moves
    out.mkdir(parents=True, exist_ok=True)
    a, b = (measure(one.spec.robot, one, out) for one in programs)
    known = compared(a, b)
    limit = NormalDist().inv_cdf(1 - (1 - SURE) / 2 / len(known))  # Bonferroni
    rows = [row for row in known if abs(row[5]) > limit]
    for joint, nm in a.friction.items():
        other = b.friction[joint]
        print(f"{joint:22}{nm:7.2f} {other:7.2f} N·m {more(nm, other):>7}")
    counted = f"{len(rows)} of {len(known)} parameters differ, {SURE:.0%} sure for all together"
    print(counted)
    for name, unit, x, y, std, z in rows[:6]:
        print(f"  {name}: {x:.3g} → {y:.3g} ± {std:.2g} {unit} ({z:+.1f} standard errors)")
    (out / "compared.html").write_text(page(a, b, rows, counted), "utf-8")
    print(f"page: {out / 'compared.html'}")


def main(
    first: str,
    second: str,
    spec: Annotated[Path, typer.Option(help="Program, with one fit.")] = Path(
        "experiments/fleet_fourier.yaml"
    ),
    station: Annotated[Path, typer.Option(help="Has both arms.")] = Path(
        "experiments/stations/fleet_mock.yaml"
    ),
    out: Annotated[Path, typer.Option(help="Folder for runs and page.")] = Path("compared"),
) -> None:
    """Compare two arms of a station; the page is `compared.html` in the folder of --out."""
    try:
        compare(first, second, spec, station, out)
    except (HilError, OSError) as error:
        print(f"not compared: {error}")
        raise typer.Exit(error.exit_code if isinstance(error, HilError) else 7) from error


if __name__ == "__main__":
    app = typer.Typer(context_settings={"help_option_names": ["-h", "--help"]})
    app.command()(main)
    app()
