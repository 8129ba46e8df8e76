"""A real browser draws the page, under the page's own content security policy."""

import shutil
import subprocess

import numpy as np
import pytest

from hil.report import colours, render_report
from hil.report.page import Badge, Column, Page, Section, Table, cells, page_html
from hil.studies.figure import Curve, Figure, Look, Panel
from tests.support.report_runs import fourier_plan, write_run

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
def test_a_browser_that_cannot_unpack_the_library_says_so(tmp_path):
    page = render_report(write_run(tmp_path, fourier_plan()).path)
    without = page.read_text("utf-8").replace(
        "<head>", "<head><script>DecompressionStream = 0</script>"
    )
    page.write_text(without, "utf-8")
    seen = dom(page, tmp_path)
    assert '<p class="lead" id="no-plots">The plots of this page need a browser of 2023' in seen
    assert 'class="main-svg"' not in seen


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


@pytest.mark.wire
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (apt-get install chromium)")
@pytest.mark.skipif(shutil.which("pdftotext") is None, reason="no pdftotext is installed")
def test_on_paper_plots_stand_on_one_sheet_with_their_heading(tmp_path):
    ends = np.arange(2.0)
    curve = Curve("a", ends, ends, look=Look(colours.MEASURED))
    blocks = [
        Figure(
            f"f{i}",
            f"Heading {i}",
            "Words that take some lines. " * 5,
            tuple(Panel(f"Panel {j} of {i}", "t [s]", "i [A]", (curve,)) for j in range(6)),
            0,
        )
        for i in range(4)
    ]
    page = tmp_path / "page.html"
    sections = (Section("s", "Plots", "", tuple(blocks)),)
    page.write_text(page_html(Page("paper", "", Badge("", ""), "", sections=sections)), "utf-8")
    browser(page, tmp_path, f"--print-to-pdf={tmp_path / 'page.pdf'}")
    told = subprocess.run(["pdftotext", tmp_path / "page.pdf", "-"], capture_output=True, text=True)
    sheets = told.stdout.split("\f")
    for i in range(4):
        texts = (f"Heading {i}", *(f"Panel {j} of {i}" for j in range(6)))
        assert any(all(text in sheet for text in texts) for sheet in sheets), f"plots {i}"
    assert len(sheets) > 3


@pytest.mark.wire
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (apt-get install chromium)")
def test_on_a_phone_a_row_of_a_table_is_a_few_lines_high_and_its_first_words_are_seen(tmp_path):
    playwright = pytest.importorskip("playwright.sync_api")
    columns = [Column(title, number=False) for title in ("taken", "what it says", "by", "of")]
    said = "probe 1 of this program under this champion: nothing to compare with yet"
    row = cells("22 Nov 2026, 20:49 UTC", said, "a champion of some name", "0002-ur5-probe")
    section = Section("s", "Probes", "", (Table("Every probe", tuple(columns), (row,)),))
    page = tmp_path / "page.html"
    page.write_text(page_html(Page("phone", "", Badge("", ""), "", sections=(section,))), "utf-8")
    with playwright.sync_playwright() as started:
        opened = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        seen = opened.new_page(viewport={"width": 390, "height": 844})
        seen.goto(page.as_uri())
        height = seen.evaluate("document.querySelector('tbody tr').getBoundingClientRect().height")
        over = seen.evaluate("document.documentElement.scrollWidth - innerWidth")
        right = seen.evaluate("document.querySelector('tbody td').getBoundingClientRect().right")
        opened.close()
    assert (over, height < 4.5 * 24) == (0, True), height
    assert right <= 390


def dom(page, folder):
    """The page as the browser leaves it."""
    return browser(page, folder, "--dump-dom")


def browser(page, folder, what):
    """What the browser prints when it does `what` with the page."""
    command = [
        CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
        f"--user-data-dir={folder / 'profile'}", "--window-size=1200,3000",
        "--virtual-time-budget=10000", what, page.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)
    return done.stdout
