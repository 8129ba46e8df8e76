"""A real browser draws the page, under the page's own content security policy."""

import shutil
import subprocess

import pytest
from report_runs import fourier_plan, write_run

from hil.report import render_report

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


@pytest.mark.wire
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (apt-get install chromium)")
def test_the_plots_near_the_top_are_drawn(tmp_path):
    page = render_report(write_run(tmp_path, fourier_plan()).path)
    command = [
        CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
        f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1280,3000",
        "--virtual-time-budget=10000", "--dump-dom", page.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)
    assert done.stdout.count('class="main-svg"') >= 6
