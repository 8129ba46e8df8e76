"""How the picture of a plan looks, in light and in dark."""

from __future__ import annotations

STYLE = """
svg { --page: #ffffff; --ink: #1c1c1c; --soft: #595959; --grid: #e4e4e4; --motion: #9fb4c4;
  --mark: #0072b2; --up: #0072b2; --down: #cd7d00; --limit: #b974a8; --speed: #3493ff;
  --acceleration: #cd7d00; --inbar: #1c1c1c;
  --j0: #0072b2; --j1: #cd7d00; --j2: #009e73; --j3: #ac3f00; --j4: #b974a8; --j5: #3493ff;
  --j6: #595959; font-family: system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
@media (prefers-color-scheme: dark) {
  svg { --page: #15181c; --ink: #ececec; --soft: #b3b3b3; --grid: #2d3238; --motion: #4d6375;
  --mark: #4da3f7; --up: #4da3f7; --down: #f2dc3a; --limit: #ce86c4; --speed: #2b78a6;
  --acceleration: #8f6a1c; --inbar: #ffffff;
  --j0: #4da3f7; --j1: #f2dc3a; --j2: #33f08f; --j3: #ff7038; --j4: #ce86c4; --j5: #b8dfff;
  --j6: #a3a3a3; } }
.page { fill: var(--page) } text { fill: var(--ink); font-size: 13px }
.title { font-size: 24px; font-weight: 600 } .head { font-size: 15px; font-weight: 600 }
.soft, .axis { fill: var(--soft) } .axis { font-size: 12px }
.end { text-anchor: end } .middle, .sign { text-anchor: middle }
.inbar { fill: var(--inbar); font-size: 11.5px }
path { fill: none } .grid, .base { stroke: var(--grid); stroke-width: 1 }
.frame { fill: none; stroke: var(--grid) }
.motion { stroke: var(--motion); stroke-width: .8 }
.measured { stroke: var(--mark); stroke-width: 1.5 }
.mark { stroke: var(--mark); stroke-width: 2.6; stroke-linecap: round }
.place { stroke: var(--mark); stroke-width: 4; stroke-linecap: round; opacity: .65 }
.foot { fill: var(--page); stroke: var(--ink); stroke-width: 2 }
.joint { stroke-width: 1.7 }
.j0 { stroke: var(--j0) } .j1 { stroke: var(--j1); stroke-dasharray: 7 3 }
.j2 { stroke: var(--j2); stroke-dasharray: 2 3 } .j3 { stroke: var(--j3); stroke-dasharray: 11 4 }
.j4 { stroke: var(--j4); stroke-dasharray: 8 3 2 3 } .j5 { stroke: var(--j5);
  stroke-dasharray: 12 3 2 3 }
.j6 { stroke: var(--j6) }
.band { opacity: .22 } .up { fill: var(--up) } .down { fill: var(--down) }
.level { fill: var(--soft); opacity: .1 } .sign { font-size: 9px }
.bar.speed { fill: var(--speed) } .bar.acceleration { fill: var(--acceleration) }
.limit { stroke: var(--limit); stroke-width: 2; stroke-dasharray: 6 3 }
"""
