"""Figures of runs and pages, and tables of studies, as files for papers.

Figures become PDF, SVG or PNG; tables become CSV with all digits, and LaTeX to be read.
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
    """One table or figure of a study.

    Attributes:
        stem: File name without its ending, unique among all of a run.
        study: Title of the study, unlike that of every other of the run.
        part: Where it stands.
        what: The table or figure itself.
    """

    stem: str
    study: str
    part: Part
    what: Table | Figure


def figures(
    run: AnyPath, out: AnyPath, *, formats: Sequence[str] = ("pdf",), width: str = "column"
) -> list[Path]:
    """Write the figures of a run or a page, and tables of studies, as files for papers.

    A figure of a study becomes `<key>.pdf` and the like, a table `<key>.csv` and `<key>.tex`, a
    figure of the page `<section>-<title>.pdf`; `contents.md` holds titles, captions and notes.
    Files that are there are replaced.

    Args:
        run: The run directory, or an HTML page that hil wrote.
        out: Folder for the files; made when missing.
        formats: Of the figures: `pdf`, `svg`, `png`.
        width: `column` (88 mm) or `page` (181 mm).

    Returns:
        What was written.

    Raises:
        DataError: There is no figure, or a study or the page is damaged.
        SpecError: There is no such format or width.
        RecordingError: The folder cannot be written to.
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
            f"cannot make the folder {out}: {error.strerror}", hint="choose another place for it"
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
            raise SpecError(f"there is no {what} {name!r}", hint=f"choose from {', '.join(known)}")


def _page_plots(run: Path, told: bool) -> list[tuple[str, Placed]]:
    """The plots of a page, or of a run's report but those of its studies, with names for files.

    Args:
        run: A page or a run directory.
        told: Whether the run has figures besides; else a report without plots is an error.
    """
    page = run / REPORT_FILE if run.is_dir() else run
    if run.is_dir() and not page.exists():
        if told:
            return []
        raise DataError(f"{run} has no report yet", hint=f"make it first: hil report {run}")
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
    """`excitation-pose-map`; what a title adds behind a comma is left out."""
    title = _slug(re.split(r"[,?]", plots.figure.title.lower())[0])
    return title if title == plots.section else _slug(plots.section, title)


def _slug(*words: str) -> str:
    """Words as part of a file name."""
    return "-".join(filter(None, (re.sub(r"[^\w.]+", "-", word).strip("-.") for word in words)))


def _files(item: Item, formats: Sequence[str], width: str) -> Iterator[tuple[str, bytes]]:
    if isinstance(item.what, Table):
        yield f"{item.stem}.csv", csv_text(item.what).encode()
        yield f"{item.stem}.tex", latex_text(item.what).encode()
        return
    for name in dict.fromkeys(formats):
        yield f"{item.stem}.{name}", drawn(item.what, name, width)


def _contents(found: Sequence[Item]) -> str:
    """What each file holds, with the caption: figures as files have none."""
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
    """All tables and figures with names for their files.

    The key is the name. Where two protocols of a study have the same key, the protocol stands
    behind it (`fig-7-paper`); where a run has several studies, their names stand before it.
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
    """The table as CSV: numbers with all digits, nothing where there is none."""
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
    """The table as a `tabular` with the rules of booktabs; title and note above it."""
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
"""What LaTeX does not take as it is; everything else is UTF-8, which it has read since 2018."""


def _escaped(text: str, is_number: bool = False) -> str:
    # A hyphen is shorter than a minus.
    return (text.replace("-", "−") if is_number else text).translate(_LATEX)


def _row(texts: Sequence[str]) -> str:
    """A row; a bracket at its beginning would be taken for an option of the line before."""
    first = "{}" if texts[0].startswith("[") else ""
    return first + " & ".join(texts) + r" \\"
