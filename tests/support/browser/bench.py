"""A dashboard as its own process, and the distribution's Chromium in front of it."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import sync_playwright

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
STARTS_WITHIN_S = 30.0
SMALL = """
hil: 1
name: small
description: Two loads, mounted by hand
robot: ur5
excitation: {kind: fourier, trajectories: 2, fundamental_hz: 0.1, seed: 3}
warm_up: {duration_s: 0}
loads:
  - {mass_kg: 0, prompt: Remove everything from the flange}
  - {mass_kg: 1.5, com_m: [0, 0, 0.05], prompt: Mount the weight}
"""
STATION = """
hil_station: 1
name: bench
robots:
  ur5: {driver: mock, model: ur5, options: {seed: 5, clock: wall}}
"""


def chromium() -> str:
    """The browser of the distribution; tests are skipped, with what to install, without one."""
    for name in NAMES:
        if path := shutil.which(name):
            return path
    missing = "no Chromium: apt install chromium"
    if os.environ.get("CI"):
        pytest.fail(missing)  # a green CI has seen the dashboard
    pytest.skip(missing)


@contextlib.contextmanager
def opened() -> Iterator[Any]:
    """That browser, without a window."""
    path = chromium()
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


@contextlib.contextmanager
def serving(folder: Path, *options: str) -> Iterator[str]:
    """`hil serve` in a folder of its own; its address."""
    with served(folder, *options) as (address, _):
        yield address


@contextlib.contextmanager
def served(folder: Path, *options: str) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """The same, with its process, which may be stopped (SIGSTOP)."""
    command = [sys.executable, "-m", "hil", "serve", "--port", "0", *options]
    environment = {**os.environ, "HIL_LEASES": str(folder / "leases")}
    with (folder / "serve.log").open("wb") as errors:
        process = subprocess.Popen(
            command, cwd=folder, stdout=subprocess.PIPE, stderr=errors, env=environment, text=True
        )
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line.startswith("dashboard: "), (folder / "serve.log").read_text("utf-8")
            yield line.removeprefix("dashboard: ").strip(), process
        finally:
            process.send_signal(signal.SIGCONT)
            process.send_signal(signal.SIGINT)
            try:
                process.wait(10)
            finally:
                process.kill()
                process.stdout.close()
