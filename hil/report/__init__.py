"""HTML reports and terminal summaries of runs and models, and their figures.

Every report is one self-contained HTML page. The modules `documents`, `run_facts`, `fit_facts` and
`run_recording` read files and tolerate missing or damaged files. The module `predictions` computes
model predictions for figures. The modules `words`, `run_summary` and `next_step` write the texts of
reports. The modules `run_report`, `model_sections`, `study_sections` and `*_page` compose pages
from the blocks of `page`. The modules `hil.studies.figure` and `figure_list` describe figures
independently of a plotting library. The module `plotly_figure` draws figures in pages;
`matplotlib_figure`, `paper` and `plan_drawing` draw figures in files.

The libraries plotly, matplotlib and Jinja2 are imported only when needed.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
