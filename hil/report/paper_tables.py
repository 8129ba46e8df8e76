"""Tables of studies as CSV with all digits, and as LaTeX to be read."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

from hil.report.study_words import columns_of, is_numeric
from hil.studies import Table, Value

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


def csv_text(table: Table) -> str:
    """The table as CSV: numbers with all digits, nothing where there is none."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table.columns)
    writer.writerows([_exact(value) for value in row] for row in table.rows)
    return text.getvalue()


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


def _exact(value: Value) -> str:
    if value is None or value != value:
        return ""
    return repr(value) if isinstance(value, float) else str(value)


def _row(texts: Sequence[str]) -> str:
    """A row; a bracket at its beginning would be taken for an option of the line before."""
    first = "{}" if texts[0].startswith("[") else ""
    return first + " & ".join(texts) + r" \\"


def _escaped(text: str, is_number: bool = False) -> str:
    # A hyphen is shorter than a minus.
    return (text.replace("-", "−") if is_number else text).translate(_LATEX)
