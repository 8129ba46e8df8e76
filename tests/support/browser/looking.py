"""What a person would notice on a page: errors, keys that lead nowhere, text one cannot read."""

from __future__ import annotations

import time
from typing import Any

MOST_TABS = 120

_CONTRASTS = """
(least) => {
  const parts = (text) => (text.match(/[\\d.]+/g) || []).map(Number);
  const light = (c) => {
    const [r, g, b] = c.slice(0, 3).map((v) => v / 255)
      .map((v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const behind = (element) => {
    for (let one = element; one; one = one.parentElement) {
      const c = parts(getComputedStyle(one).backgroundColor);
      if (c.length === 3 || c[3] === 1) return c;
    }
    return matchMedia("(prefers-color-scheme: dark)").matches ? [18, 18, 18] : [255, 255, 255];
  };
  const found = new Set();
  const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walk.nextNode()) {
    const element = walk.currentNode.parentElement;
    const box = element.getBoundingClientRect();
    if (!walk.currentNode.textContent.trim() || box.width <= 1 || box.right < 0) continue;
    if (element.closest("script, style, option") || !element.checkVisibility()) continue;
    const [ink, page] = [parts(getComputedStyle(element).color), behind(element)].map(light);
    const ratio = (Math.max(ink, page) + 0.05) / (Math.min(ink, page) + 0.05);
    if (ratio < least) {
      const text = walk.currentNode.textContent.trim().slice(0, 40);
      found.add(`contrast ${ratio.toFixed(2)}: ${text}`);
    }
  }
  return [...found];
}
"""


def problems_of(page: Any) -> list[str]:
    """A list that fills with what goes wrong on a page: its console, errors, what failed."""
    said: list[str] = []
    page.on("console", lambda told: said.append(told.text) if told.type != "log" else None)
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("response", lambda got: said.append(f"{got.status} {got.url}") if _bad(got) else None)
    return said


def tab_to(page: Any, selector: str) -> None:
    """Go on by the Tab key until an element has the focus, and shows it."""
    for _ in range(MOST_TABS):
        page.keyboard.press("Tab")
        if page.evaluate("(s) => document.activeElement?.matches(s)", selector):
            style = "getComputedStyle(document.activeElement).outlineStyle"
            assert page.evaluate(style) != "none", f"nobody sees that {selector} has the focus"
            return
    raise AssertionError(f"the Tab key never reaches {selector}")


def enter(page: Any) -> None:
    """Follow the link, or press the button, that has the focus, to another page."""
    with page.expect_navigation():
        page.keyboard.press("Enter")


def until(page: Any, truth: str, within_s: float) -> None:
    """Wait for an expression to become true; the page's policy forbids the driver's own way."""
    deadline = time.monotonic() + within_s
    while not page.evaluate(truth):
        assert time.monotonic() < deadline, f"not within {within_s:g} s: {truth}"
        page.wait_for_timeout(20)


def contrasts_below(page: Any, least: float) -> list[str]:
    """Texts with less contrast than WCAG 2.1 (1.4.3) asks for."""
    found: list[str] = page.evaluate(_CONTRASTS, least)
    return found


def _bad(response: Any) -> bool:
    return bool(response.status >= 400)
