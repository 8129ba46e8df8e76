"""Makes the pictures of docs/gallery.md: runs its commands in a folder of their own, then looks.

`make gallery`, or `python -m tests.docs.gallery FOLDER` with a folder where the commands have been
run. Needs Chromium; takes several minutes.
"""

from __future__ import annotations

import io
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.docs.gallery_dashboard import LIVE, MOVING, WHO, looked_at
from tests.support.docs_commands import blocks
from tests.support.paths import DOCS, EXPERIMENTS

PAGE = DOCS / "gallery.md"
OUT = DOCS / "images" / "gallery"
README_PICTURE = DOCS / "images" / "report.png"
DRAWN = """async () => {
  document.querySelectorAll('details').forEach((part) => { part.open = true; });
  for (let y = 0; y < document.documentElement.scrollHeight; y += 500) {
    scrollTo({top: y, behavior: 'instant'});
    await new Promise((done) => setTimeout(done, 80));
  }
  scrollTo({top: 0, behavior: 'instant'});
  await new Promise((done) => setTimeout(done, 800));
}"""
PLACE = """([section, title, most]) => {
  const near = document.getElementById(section).closest('section');
  const head = [...near.querySelectorAll('h3')].find((each) => each.textContent === title);
  let last = head;
  while (!last.classList.contains('panels')) last = last.nextElementSibling;
  const top = head.getBoundingClientRect().top - 8;
  const ends = [...last.children].map((panel) => panel.getBoundingClientRect().bottom + 8 - top);
  return [top + scrollY, Math.max(...ends.filter((end) => end <= most))];
}"""


@dataclass(frozen=True)
class Shot:
    """A picture: of the top of a page, or of plots under a heading.

    Attributes:
        file: Of the page or picture, a pattern in the folder of the commands; with a slash before
            it, the address of a page of the dashboard.
        section: Id of the section; empty for the top of the page.
        title: Heading of the plots in it.
        size: Of the window; pictures of plots end with the last panel that is whole in that height.
        dark: In the dark theme.
    """

    file: str
    section: str = ""
    title: str = ""
    size: tuple[int, int] = (1240, 900)
    dark: bool = False


DWELL = "runs/*/ur5/0001-*/report.html"
FOURIER = "runs/*/ur5/0002-*/report.html"
WEEKS = "runs/*/simulations/*/report.html"
SHOTS = {
    "report": Shot(DWELL),
    "report-dark": Shot(DWELL, dark=True),
    "report-phone": Shot(DWELL, "model-1", "Held-out dwells: measured and predicted", (390, 844)),
    "dwells": Shot(DWELL, "model-1", "Held-out dwells: measured and predicted"),
    "residuals": Shot(DWELL, "model-1", "Held-out dwells: residual against pose"),
    "health": Shot(DWELL, "recording", "Over time"),
    "trajectory": Shot(FOURIER, "model-2", "Held-out trajectory: measured and predicted"),
    "friction": Shot(FOURIER, "model-1", "Friction over velocity"),
    "coverage": Shot(FOURIER, "excitation", "Position and velocity coverage"),
    "plan": Shot("plan.svg"),
    "excite": Shot("excite.html", "worth", "Together"),
    "motion": Shot("excite.html", "trajectory-1", "Motion", (1240, 1000)),
    "loads": Shot("runs/*/ur5/0003-*/report.html", "study-1-1", "Errors under loads"),
    "series": Shot("runs/*/series/*/series.html"),
    "try-out": Shot("trial/report.html", "study-1-1", "Tracking error"),
    "simulation": Shot(WEEKS),
    "weeks": Shot(WEEKS, "weeks", "Error"),
    "chance": Shot("drift.html", "probes", "Chance"),
    "drift": Shot("drift.html", "friction", "Friction"),
    "fleet": Shot("runs/*/fleet/*/fleet.html", "friction", "Friction over age"),
    "dashboard": Shot("/"),
    "dashboard-dark": Shot("/", dark=True),
    "live": Shot(LIVE),
    "live-dark": Shot(LIVE, dark=True),
    "run": Shot("/runs/*/ur5/0002-*"),
    "run-dark": Shot("/runs/*/ur5/0002-*", dark=True),
    "model": Shot("/models/ur5"),
    "model-dark": Shot("/models/ur5", dark=True),
    "schedule": Shot("/schedules/ur5-weekly"),
    "schedule-dark": Shot("/schedules/ur5-weekly", dark=True),
    "moving": Shot(MOVING, size=(1240, 1240)),  # answered: what shows the question comes before
    "paper": Shot("paper/model-2-held-out-trajectory-measured-and-predicted.png"),
}


def run_commands(folder: Path) -> None:
    """Run every command of the page, in its order, and keep its files."""
    (folder / "experiments").symlink_to(EXPERIMENTS)
    made = [b for b in blocks(PAGE) if b.language == "sh" or b.asked[:5] == "file:"]
    parts = [b.script() for b in made if serve_command() not in b.commands]
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    kept = {k: v for k, v in os.environ.items() if not k.startswith("HIL_")}
    script = "".join(parts)
    subprocess.run(
        ["bash", "-euxo", "pipefail", "-c", script],
        cwd=folder,
        env=kept | {"PATH": path, "LOGNAME": WHO},
        check=True,
    )


def serve_command() -> str:
    """The only command of the page that does not end."""
    (found,) = (c for b in blocks(PAGE) for c in b.commands if c.startswith("hil serve"))
    return str(found)


def take(folder: Path, names: Sequence[str]) -> None:
    """Take the pictures of these names, in place of those there are."""
    from playwright.sync_api import sync_playwright

    OUT.mkdir(parents=True, exist_ok=True)
    program = shutil.which("chromium") or shutil.which("google-chrome")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        if served := [name for name in names if SHOTS[name].file.startswith("/")]:
            with looked_at(browser, folder, serve_command()) as dashboard:
                for name in served:
                    shot = SHOTS[name]
                    raw = dashboard.picture(shot.file, shot.size, dark=shot.dark)
                    _keep(raw, OUT / f"{name}.webp")
        for name in (each for each in names if each not in served):
            shot = SHOTS[name]
            file = next(iter(sorted(folder.glob(shot.file))))
            raw = file.read_bytes() if file.suffix == ".png" else _picture(browser, file, shot)
            _keep(raw, OUT / f"{name}.webp")
            if name == "report":
                README_PICTURE.write_bytes(_fewer_colours(raw))
        browser.close()


def _picture(browser: Any, file: Path, shot: Shot) -> bytes:
    width, height = shot.size
    phone = width < 500
    page = browser.new_page(
        viewport={"width": width, "height": height},
        color_scheme="dark" if shot.dark else "light",
        is_mobile=phone,
        has_touch=phone,
    )
    page.goto(file.resolve().as_uri())
    if file.suffix == ".svg":
        return bytes(page.screenshot())
    page.evaluate(DRAWN)
    asked = [shot.section, shot.title, height]
    top, tall = page.evaluate(PLACE, asked) if shot.section else (0, height)
    clip = {"x": 0, "y": top, "width": width, "height": tall}
    page.add_style_tag(content="nav { position: static !important; }")
    taken = bytes(page.screenshot(full_page=True, clip=clip, timeout=180_000))
    page.close()
    return taken


def _keep(raw: bytes, file: Path) -> None:
    from PIL import Image

    image = Image.open(io.BytesIO(raw)).convert("RGB")
    if image.width > 1100:
        image = image.resize((1100, round(image.height * 1100 / image.width)))
    image.save(file, "WEBP", quality=82, method=6)
    sys.stdout.write(f"{file.name}: {image.width} x {image.height}, {file.stat().st_size} bytes\n")


def _fewer_colours(raw: bytes) -> bytes:
    from PIL import Image

    out = io.BytesIO()
    Image.open(io.BytesIO(raw)).convert("RGB").quantize(128).save(out, "PNG", optimize=True)
    return out.getvalue()


def main(arguments: Sequence[str]) -> None:
    """Without a folder the commands are run first, in a new one; names choose pictures."""
    if arguments:
        take(Path(arguments[0]), arguments[1:] or list(SHOTS))
        return
    with tempfile.TemporaryDirectory() as folder:
        run_commands(Path(folder))
        take(Path(folder), list(SHOTS))


if __name__ == "__main__":
    main(sys.argv[1:])
