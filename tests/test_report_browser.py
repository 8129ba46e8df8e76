"""A real browser draws the page, under the page's own content security policy."""

import shutil
import subprocess

import pytest
from report_runs import fourier_plan, write_run

from hil.report import render_report
from hil.report.blocks import Badge, Page, Section
from hil.report.render import page_html

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


@pytest.mark.wire
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (apt-get install chromium)")
def test_the_plots_near_the_top_are_drawn(tmp_path):
    page = render_report(write_run(tmp_path, fourier_plan()).path)
    assert dom(page, tmp_path).count('class="main-svg"') >= 6


@pytest.mark.wire
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (apt-get install chromium)")
def test_every_name_of_the_contents_can_be_seen_on_a_laptop(tmp_path):
    titles = [f"Study: one of {i} with a title that is as long as titles are" for i in range(6)]
    sections = tuple(Section(f"s{i}", title) for i, title in enumerate(titles))
    ask = "document.title = document.querySelector('nav ul').scrollWidth <= innerWidth"
    page = tmp_path / "page.html"
    html = page_html(Page("long", "", Badge("PASSED", "pass"), "", sections=sections))
    page.write_text(html.replace("</body>", f"<script>{ask}</script></body>"), "utf-8")
    assert "<title>true</title>" in dom(page, tmp_path)


def dom(page, folder):
    """The page as the browser leaves it."""
    command = [
        CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
        f"--user-data-dir={folder / 'profile'}", "--window-size=1200,3000",
        "--virtual-time-budget=10000", "--dump-dom", page.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)
    return done.stdout
