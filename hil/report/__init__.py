"""One self-contained HTML page per run or model, and the same summary for a terminal.

plotly and Jinja2 are imported when a page is rendered, not before.
"""

from hil.report.report import render_fit_report, render_report
from hil.report.text import summary_lines

__all__ = ["render_fit_report", "render_report", "summary_lines"]
