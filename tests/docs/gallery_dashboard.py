"""The dashboard for the gallery: served by the command of its page, with a run that waits."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

SPEC, STATION = "ur5_fourier_loads.yaml", "stations/mock_wall.yaml"
LIVE = "/live"
"""In place of the address of the run that is started here: while it asks; `#…` once it moves."""

MOVING = f"{LIVE}#moving"
MOVES_MS = 25_000
WHO = "ada"


class Dashboard:
    """A dashboard, a browser in front of it and a live run, made when it is first looked at."""

    def __init__(self, browser: Any, address: str, folder: Path) -> None:
        self._browser, self._address, self._folder = browser, address, folder
        self._live = ""

    def picture(self, path: str, size: tuple[int, int], *, dark: bool) -> bytes:
        """The top of a page; `*` in its path is what is there in the folder of the commands."""
        page = self._page(size, dark=dark)
        page.goto(self._address + self._where(path))
        if path == MOVING:
            _answer(page)
        page.wait_for_timeout(1500)
        taken = bytes(page.screenshot())
        page.context.close()
        return taken

    def stop(self) -> None:
        """Stop the run that was started."""
        if self._live:
            page = self._page((1240, 900))
            page.goto(self._address + self._live)
            page.click(".stopping button.stop")
            page.wait_for_selector("[data-shown=over]:visible", timeout=60_000)

    def _page(self, size: tuple[int, int], *, dark: bool = False) -> Any:
        theme = "dark" if dark else "light"
        viewport = {"width": size[0], "height": size[1]}
        context = self._browser.new_context(viewport=viewport, color_scheme=theme)
        context.add_cookies([{"name": "hil_who", "value": WHO, "url": self._address}])
        return context.new_page()

    def _where(self, path: str) -> str:
        if path == "/" or path.startswith(LIVE):
            self._live = self._live or self._begun()
            return path if path == "/" else self._live
        if "*" not in path:
            return path
        return "/" + min(self._folder.glob(path[1:])).relative_to(self._folder).as_posix()

    def _begun(self) -> str:
        page = self._page((1240, 900))
        page.goto(f"{self._address}/start")
        page.select_option("select[name=spec]", SPEC)
        page.select_option("select[name=station]", STATION)
        page.click("button[value=start]")
        page.wait_for_url("**/runs/**", timeout=120_000)
        page.wait_for_selector(".question:visible", timeout=120_000)
        where = str(page.url).removeprefix(self._address)
        page.context.close()
        return where


@contextlib.contextmanager
def looked_at(browser: Any, folder: Path, command: str) -> Iterator[Dashboard]:
    """A dashboard in the folder of the commands, until the pictures are taken."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    env = os.environ | {"PATH": path, "HIL_LEASES": str(folder / ".leases")}
    words = ["bash", "-c", f"exec {command} --port 0"]
    with subprocess.Popen(words, cwd=folder, env=env, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        made = Dashboard(browser, line.removeprefix("dashboard: ").strip().rstrip("/"), folder)
        try:
            yield made
            made.stop()
        finally:
            process.send_signal(signal.SIGINT)


def _answer(page: Any) -> None:
    """Say yes, and let the arm move until its curves can be seen."""
    yes = "button[value=yes]:not([aria-disabled=true])"
    page.click(yes, timeout=10_000)
    page.wait_for_selector(".question", state="hidden")
    page.wait_for_timeout(MOVES_MS)
