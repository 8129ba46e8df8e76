"""The palette: read on both pages, and told apart with every common form of colour blindness.

Contrast as in WCAG 2.2 (1.4.3: text 4.5:1; 1.4.11: lines and marks 3:1). What a dichromat sees is
simulated after Machado, Oliveira and Fernandes, 'A Physiologically-based Model for Simulation of
Color Vision Deficiency', IEEE TVCG 15 (2009), severity 1.0, applied to linear RGB. Distances are
CIE 1976, of which about 2.3 is just noticed side by side.
"""

from __future__ import annotations

import re
from importlib.resources import files
from itertools import combinations

import numpy as np
import pytest

from hil.core.typing import FloatArray
from hil.report import colours
from hil.report.colours import PALETTE
from hil.report.matplotlib_figure import THEME

APART = 15.0
VISION = {
    "normal": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
                   [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
                     [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
                   [0.004733, 0.691367, 0.303900]],
}  # fmt: skip
TO_XYZ = np.array([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750],
                   [0.0193339, 0.1191920, 0.9503041]])  # fmt: skip
WHITE = np.array([0.95047, 1.0, 1.08883])
CSS = files("hil.report").joinpath("report.css").read_text("utf-8")
LIGHT, DARK = (
    dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", part)) for part in CSS.split("@media")[:2]
)
BEHIND = {"pass": "pass-back", "fail": "fail-back", "warn": "warn-back"}
THEMES = {"light": (LIGHT, {c: c for c in colours.DARK}), "dark": (DARK, colours.DARK)}


def linear(colour: str) -> FloatArray:
    """sRGB as linear RGB."""
    c = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def contrast(a: str, b: str) -> float:
    """Of two colours, as WCAG defines it."""
    low, high = sorted(float(linear(c) @ [0.2126, 0.7152, 0.0722]) for c in (a, b))
    return (high + 0.05) / (low + 0.05)


def lab(colour: str, vision: str) -> FloatArray:
    """CIELAB of what is seen."""
    seen = np.clip(np.array(VISION[vision]) @ linear(colour), 0, 1)
    ratio = TO_XYZ @ seen / WHITE
    small = ratio * (29 / 6) ** 2 / 3 + 4 / 29
    f = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), small)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def apart(a: str, b: str, vision: str) -> float:
    """How far two colours are from each other."""
    return float(np.linalg.norm(lab(a, vision) - lab(b, vision)))


def test_measures_are_those_of_the_standards() -> None:
    assert contrast("#000000", "#ffffff") == pytest.approx(21)
    assert contrast("#777777", "#ffffff") == pytest.approx(4.48, abs=0.01)
    assert lab("#ff0000", "normal") == pytest.approx([53.24, 80.09, 67.20], abs=0.05)
    red, green = (lab(c, "deuteranopia") for c in ("#b00000", "#6a6a00"))
    assert np.linalg.norm(red - green) < 0.5 * apart("#b00000", "#6a6a00", "normal")


@pytest.mark.parametrize("theme", THEMES)
def test_lines_and_marks_stand_out_from_the_page(theme: str) -> None:
    css, of = THEMES[theme]
    weak = {c: contrast(of[c], css["page"]) for c in colours.DARK if c != colours.FILL}
    assert {c: x for c, x in weak.items() if x < 3.0} == {}


@pytest.mark.parametrize("theme", THEMES)
@pytest.mark.parametrize("vision", VISION)
def test_colours_that_stand_together_are_told_apart(theme: str, vision: str) -> None:
    of = THEMES[theme][1]
    close = {
        (a, b): round(apart(of[a], of[b], vision), 1)
        for palette in (colours.JOINTS, PALETTE)
        for a, b in combinations(palette, 2)
        if apart(of[a], of[b], vision) < APART
    }
    assert close == {}


@pytest.mark.parametrize("theme", THEMES)
def test_letters_can_be_read(theme: str) -> None:
    css = THEMES[theme][0]
    pairs = [(text, back) for text in ("ink", "muted", "link") for back in ("page", "raised")]
    pairs += [*BEHIND.items(), *((text, "page") for text in BEHIND)]
    pairs += [("ink", back) for back in BEHIND.values()]
    weak = {(a, b): contrast(css[a], css[b]) for a, b in pairs if contrast(css[a], css[b]) < 4.5}
    assert weak == {}
    assert contrast(css["axis"], css["page"]) >= 3.0


@pytest.mark.parametrize("theme", THEMES)
def test_a_picture_speaks_the_same_language(theme: str) -> None:
    of = THEMES[theme][1]
    told = {light: light if theme == "light" else dark for light, (_, dark) in THEME.items()}
    assert {c: told[c.lower()].upper() for c in colours.DARK} == {c: of[c] for c in colours.DARK}
    assert contrast(told["#000000"], told["#ffffff"]) >= 4.5
    weak = {c: contrast(told[c.lower()], told["#ffffff"]) for c in colours.DARK}
    assert {c: x for c, x in weak.items() if x < 3.0 and c != colours.FILL} == {}


def test_joints_differ_in_dash_and_mark_as_well() -> None:
    looks = zip(colours.DASHES[:6], colours.SYMBOLS[:6], strict=True)
    assert len(set(looks)) == len(set(colours.DASHES[:6])) == len(set(colours.SYMBOLS[:6])) == 6
    assert set(colours.DASHES) == set(colours.STROKES)
