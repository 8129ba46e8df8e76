"""Export of figures of runs and pages, and of tables of studies, as files for publications.

Figures are exported as PDF, SVG or PNG files. Tables are exported as CSV files with full precision,
and as LaTeX files with rounded values.
"""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias, get_args

from hil.core import AnyPath, DataError, RecordingError, SpecError, path_of, write_replacing
from hil.report.matplotlib_figure import drawn
from hil.report.plotly_figure import Placed, placed_figures
from hil.report.study_sections import columns_of, distinct_titles, is_numeric
from hil.studies import Figure, Part, StudyResult, Table, Value, read_study, study_files

Format: TypeAlias = Literal["pdf", "svg", "png"]
Width: TypeAlias = Literal["column", "page"]
CONTENTS = "contents.md"
REPORT_FILE = "report.html"


@dataclass(frozen=True, slots=True)
class Item:
    """Table or figure of a study.

    Attributes:
        stem: File name without extension, unique within the run.
        study: Title of the study that contains the item, unique within the run.
        part: Part of the study that contains the item.
        what: The table or figure itself.
    """

    stem: str
    study: str
    part: Part
    what: Table | Figure


def figures(
    run: AnyPath, out: AnyPath, *, formats: Sequence[str] = ("pdf",), width: str = "column"
) -> list[Path]:
    """Write the figures of a run or a page, and the tables of studies, as files for publications.

    The file name is `<key>.pdf` (or a different extension) for a figure of a study, `<key>.csv` and
    `<key>.tex` for a table, and `<section>-<title>.pdf` for a figure of the page. The file
    `contents.md` lists titles, captions and notes of all files. Existing files with the same names
    are replaced.

    Args:
        run: Path of a run directory, or of an HTML page written by hil.
        out: Path of the output folder, which is created if missing.
        formats: File formats of the figures: `pdf`, `svg`, `png`.
        width: Width of the figures: `column` (88 mm) or `page` (181 mm).

    Returns:
        Paths of the written files.

    Raises:
        DataError: There is no figure to export, or a study or the page is damaged.
        SpecError: A file format or the width is unknown.
        RecordingError: The output folder cannot be written.
    """
    run, out = path_of(run), path_of(out)
    _require(formats, get_args(Format), "format")
    _require((width,), get_args(Width), "width")
    results = [read_study(path) for path in study_files(run)] if run.is_dir() else []
    found, plots = items(results), _page_plots(run, bool(results))
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(
            f"cannot create the folder {out}: {error.strerror}", hint="choose another folder"
        ) from None
    files = [file for item in found for file in _files(item, formats, width)]
    files += [
        (f"{stem}.{name}", drawn(each.figure, name, width))
        for stem, each in plots
        for name in dict.fromkeys(formats)
    ]
    files.append((CONTENTS, (_contents(found) + _page_contents(plots)).encode()))
    for name, content in files:
        write_replacing(out / name, content)
    return [out / name for name, _ in files]


def _require(given: Sequence[str], known: Sequence[str], what: str) -> None:
    for name in given:
        if name not in known:
            raise SpecError(f"unknown {what} {name!r}", hint=f"choose from {', '.join(known)}")


def _page_plots(run: Path, told: bool) -> list[tuple[str, Placed]]:
    """Return the plots of a page, each with a unique file name.

    Plots of studies in the report of a run are omitted here, because they are exported from the
    study results.

    Args:
        run: Path of a page or of a run directory.
        told: Whether the run has other figures than those of the page; if not, a missing report is
            an error.
    """
    page = run / REPORT_FILE if run.is_dir() else run
    if run.is_dir() and not page.exists():
        if told:
            return []
        raise DataError(f"{run} has no report yet", hint=f"write it first: hil report {run}")
    plots = [each for each in placed_figures(page) if run.is_file() or not _is_of_study(each)]
    stems = _unique([_stem(each) for each in plots])
    return list(zip(stems, plots, strict=True))


def _is_of_study(plots: Placed) -> bool:
    return plots.section.startswith("study-")


def _unique(stems: Sequence[str]) -> list[str]:
    seen: Counter[str] = Counter()
    out = []
    for stem in stems:
        seen[stem] += 1
        out.append(stem if seen[stem] == 1 else f"{stem}-{seen[stem]}")
    return out


def _stem(plots: Placed) -> str:
    """Return a file name such as `excitation-pose-map` for a plot.

    The part of the title after a comma or a question mark is omitted from the file name.
    """
    title = _slug(re.split(r"[,?]", plots.figure.title.lower())[0])
    return title if title == plots.section else _slug(plots.section, title)


def _slug(*words: str) -> str:
    """Return words in the form of a file name."""
    return "-".join(filter(None, (re.sub(r"[^\w.]+", "-", word).strip("-.") for word in words)))


def _files(item: Item, formats: Sequence[str], width: str) -> Iterator[tuple[str, bytes]]:
    if isinstance(item.what, Table):
        yield f"{item.stem}.csv", csv_text(item.what).encode()
        yield f"{item.stem}.tex", latex_text(item.what).encode()
        return
    for name in dict.fromkeys(formats):
        yield f"{item.stem}.{name}", drawn(item.what, name, width)


def _contents(found: Sequence[Item]) -> str:
    """Return a list of the files with captions, because exported figures contain no captions."""
    lines = ["# Figures and tables", ""]
    title = ""
    for item in found:
        if item.study != title and (title := item.study):
            lines += ["", f"## {title}", ""] if len(lines) > 2 else [f"## {title}", ""]
        what = item.what
        protocol = f" Protocol: {item.part.protocol}." if item.part.protocol else ""
        told = what.note if isinstance(what, Table) else what.caption
        text = f"{item.part.title}: {what.title}.{protocol} {told}".replace("..", ".")
        lines += [f"- `{item.stem}`: {text.strip()}"]
    return "\n".join(lines) + "\n"


def _page_contents(plots: Sequence[tuple[str, Placed]]) -> str:
    if not plots:
        return ""
    lines = [f"- `{stem}`: {each.place}: {each.figure.title}." for stem, each in plots]
    return "\n## Page\n\n" + "\n".join(lines) + "\n"


def items(results: Sequence[StudyResult]) -> list[Item]:
    """Return all tables and figures of studies, each with a unique file name.

    The file name of a table or figure is its key. If two parts of a study contain the same key, the
    protocol is appended (`fig-7-paper`). If a run has several studies, the name of the study is
    prepended to the file name.
    """
    titles = distinct_titles(results)
    placed = [
        (result, title, part, what)
        for result, title in zip(results, titles, strict=True)
        for part in result.parts
        for what in _in(part)
    ]
    several = len(results) > 1
    plain = [_slug(result.study, what.key) if several else _slug(what.key)
             for result, _, _, what in placed]  # fmt: skip
    marked = [
        _slug(stem, part.protocol.partition(":")[0]) if plain.count(stem) > 1 else stem
        for stem, (_, _, part, _) in zip(plain, placed, strict=True)
    ]
    stems = _unique(marked)
    return [Item(stem, *where[1:]) for stem, where in zip(stems, placed, strict=True)]


def _in(part: Part) -> tuple[Table | Figure, ...]:
    return (*part.tables, *part.figures)


def csv_text(table: Table) -> str:
    """Return the table as CSV with full precision; missing values are empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table.columns)
    writer.writerows([_exact(value) for value in row] for row in table.rows)
    return text.getvalue()


def _exact(value: Value) -> str:
    if value is None or value != value:
        return ""
    return repr(value) if isinstance(value, float) else str(value)


def latex_text(table: Table) -> str:
    """Return the table as a LaTeX `tabular` with booktabs rules.

    The title and the note of the table precede it as LaTeX comments.
    """
    said = [table.title, *([table.note] if table.note else [])]
    numeric = [is_numeric(table, i) for i in range(len(table.columns))]
    texts = [
        [_escaped(text, is_number) for text in column]
        for column, is_number in zip(columns_of(table), numeric, strict=True)
    ]
    rows = [_row(row) for row in zip(*texts, strict=True)]
    lines = [
        *(f"% {line}" for text in said for line in text.splitlines()),
        r"% needs \usepackage{booktabs}",
        rf"\begin{{tabular}}{{{''.join('r' if right else 'l' for right in numeric)}}}",
        r"\toprule",
        _row([_escaped(title) for title in table.columns]),
        r"\midrule",
        *rows,
        r"\bottomrule",
        r"\end{tabular}",
    ]
    return "\n".join(lines) + "\n"


_GREEK = {
    "α": "alpha",
    "β": "beta",
    "γ": "gamma",
    "δ": "delta",
    "ε": "varepsilon",
    "η": "eta",
    "θ": "theta",
    "λ": "lambda",
    "μ": "mu",
    "ν": "nu",
    "ξ": "xi",
    "π": "pi",
    "ρ": "rho",
    "σ": "sigma",
    "τ": "tau",
    "φ": "varphi",
    "χ": "chi",
    "ψ": "psi",
    "ω": "omega",
    "Γ": "Gamma",
    "Δ": "Delta",
    "Θ": "Theta",
    "Λ": "Lambda",
    "Π": "Pi",
    "Σ": "Sigma",
    "Φ": "Phi",
    "Ψ": "Psi",
    "Ω": "Omega",
    "ϕ": "phi",
}

_LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "&": r"\&",
        "%": r"\%",
        "$": r"\$",
        "#": r"\#",
        "_": r"\_",
        "{": r"\{",
        "}": r"\}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "<": "$<$",
        ">": "$>$",
        "|": "$|$",
        "−": "$-$",
        "–": "--",
        "—": "---",
        "…": r"\dots{}",
        "\u202f": r"\,",
        "\u00a0": "~",
        "·": r"$\cdot$",
        "×": r"$\times$",
        "±": r"$\pm$",
        "≤": r"$\le$",
        "≥": r"$\ge$",
        "≈": r"$\approx$",
        "→": r"$\to$",
        "∞": r"$\infty$",
        "√": r"$\surd$",
        "°": r"$^\circ$",
        "′": "$'$",
        "²": "$^2$",
        "³": "$^3$",
        "⁻": "$^-$",
        "¹": "$^1$",
        **{digit: f"$_{i}$" for i, digit in enumerate("₀₁₂₃₄₅₆₇₈₉")},
        **{letter: f"$\\{name}$" for letter, name in _GREEK.items()},
        "µ": r"$\mu$",
    }
)
"""Replacements for characters that LaTeX cannot process directly.

LaTeX has processed all other UTF-8 characters directly since 2018.
"""


def _escaped(text: str, is_number: bool = False) -> str:
    # Use a minus sign, because a hyphen is too short.
    return (text.replace("-", "−") if is_number else text).translate(_LATEX)


def _row(texts: Sequence[str]) -> str:
    """Return a table row in LaTeX.

    An empty group precedes a leading bracket, which LaTeX would otherwise read as an option of the
    previous row.
    """
    first = "{}" if texts[0].startswith("[") else ""
    return first + " & ".join(texts) + r" \\"
