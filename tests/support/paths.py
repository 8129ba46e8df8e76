"""Where things are in a checkout."""

from __future__ import annotations

import os
from pathlib import Path

ROOT = Path(__file__).parents[2]
EXPERIMENTS = ROOT / "experiments"
DOCS = ROOT / "docs"
FILES = Path(__file__).parent
"""Programs and documents that tests hand to others."""
DATA = Path(os.environ.get("HIL_DATA", ROOT.parent / "shared" / "data"))
