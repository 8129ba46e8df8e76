"""One self-contained HTML page per run or model, and the same summary for a terminal.

What is shown is read leniently (`documents`, `run_facts`, `fit_facts`, `run_recording`), predicted
(`predictions`) and put into words (`words`, `run_summary`, `next_step`). Pages (`run_report`,
`model_sections`, `study_sections`, `*_page`) are made of the blocks of `page`. Figures are
described once (`hil.studies.figure`, `figure_list`), and drawn by plotly in pages and by matplotlib
in files (`plotly_figure`, `matplotlib_figure`, `paper`, `plan_drawing`).

plotly, matplotlib and Jinja2 are imported when something is drawn, not before.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
