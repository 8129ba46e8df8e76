"""What differs between two arms of a station? The same program on both, a model of each, a page.

    python experiments/scripts/compare_arms.py ur5-001 ur5-017

What is called different is so with 99 % for all parameters together, by the standard errors of
both. Drive gains are taken as declared: one that is wrong by 3 % scales its joint's parameters.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist
from typing import Annotated, Any

import numpy as np
import typer

import hil
from hil.errors import HilError
from hil.identify import load_model_file
from hil.notebook import card, number

SURE = 0.99
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


def measure(name: str, spec: Path, station: Path, out: Path) -> Arm:
    """Run the program on one arm and fit it; the spec's robot is replaced."""
    out.mkdir(parents=True, exist_ok=True)
    own = out / f"{name}.yaml"
    own.write_text(re.sub(r"(?m)^robot: .*$", f"robot: {name}", spec.read_text("utf-8")), "utf-8")
    report = hil.run(hil.load(own, station), runs=out / "runs")
    if report.error is not None:
        raise report.error
    document = out / f"{name}.json"
    document.unlink(missing_ok=True)
    hil.export_model(report.models[0], document, to="json")
    model, data = load_model_file(report.models[0]), hil.dataset(report.run).of_kind("trajectory")
    torque = model.predict(data).components["friction"] * model.torque_scale_
    rms = np.sqrt(np.nanmean(torque**2, axis=0)).tolist()
    parameters = json.loads(document.read_text("utf-8"))["parameters"]
    return Arm(name, parameters, dict(zip(model.joint_names_, rms, strict=True)))


def different(a: Arm, b: Arm) -> list[Row]:
    """Parameters that differ for sure, those most standard errors apart first."""
    known = [
        (p["name"], p["unit"], p["value"], q["value"], math.hypot(p["std"], q["std"]))
        for p, q in zip(a.parameters, b.parameters, strict=True)
        if p["std"] and q["std"]
    ]
    limit = NormalDist().inv_cdf(1 - (1 - SURE) / 2 / len(known))
    rows = [(*row, (row[3] - row[2]) / row[4]) for row in known]
    return sorted((row for row in rows if abs(row[5]) > limit), key=lambda row: -abs(row[5]))


def page(a: Arm, b: Arm, rows: list[Row]) -> str:
    """HTML, with the friction of every joint first."""
    joints = [
        (joint, number(nm), number(b.friction[joint]), f"{b.friction[joint] / nm - 1:+.0%}")
        for joint, nm in a.friction.items()
    ]
    told = [(n, u, number(x), number(y), number(s), f"{z:+.1f}") for n, u, x, y, s, z in rows]
    head = ("parameter", "unit", a.name, b.name, "± of the difference", "standard errors apart")
    friction = (("RMS friction [N·m]", a.name, b.name, f"{b.name} has"), joints)
    title, counted = f"{a.name} and {b.name}", f"{len(rows)} of {len(a.parameters)} differ"
    note = f"{SURE:.0%} sure for all together; drive gains are taken as declared"
    below = card("Parameters", counted, {}, table=(head, told), most=len(told), notes=[note])
    return HEAD.format(title) + card("Two arms", title, {}, table=friction) + below


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
    """Compare two arms of a station."""
    try:
        a, b = (measure(name, spec, station, out) for name in (first, second))
    except HilError as error:
        print(f"not compared: {error.message}")
        raise typer.Exit(error.exit_code) from error
    rows = different(a, b)
    for joint, nm in a.friction.items():
        other = b.friction[joint]
        print(f"{joint:22}{nm:7.2f} {other:7.2f} N·m {other / nm - 1:+7.0%}")
    print(f"{len(rows)} of {len(a.parameters)} parameters differ, {SURE:.0%} sure for all together")
    for name, unit, x, y, std, z in rows[:6]:
        print(f"  {name}: {x:.3g} → {y:.3g} ± {std:.2g} {unit} ({z:+.1f} standard errors)")
    (out / "compared.html").write_text(page(a, b, rows), "utf-8")
    print(f"page: {out / 'compared.html'}")


if __name__ == "__main__":
    typer.run(main)
