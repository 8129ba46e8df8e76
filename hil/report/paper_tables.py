"""Tables of studies as CSV with all digits, and as LaTeX to be read."""

from __future__ import annotations

import csv
import io

from hil.report.study_words import cell_text
from hil.study.result import Table, Value

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
    numeric = [_is_numeric(table, i) for i in range(len(table.columns))]
    rows = [" & ".join(map(_escaped, row)) + r" \\" for row in table.rows]
    lines = [
        *(f"% {line}" for text in said for line in text.splitlines()),
        r"% needs \usepackage{booktabs}",
        rf"\begin{{tabular}}{{{''.join('r' if right else 'l' for right in numeric)}}}",
        r"\toprule",
        " & ".join(map(_escaped, table.columns)) + r" \\",
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


def _escaped(value: Value) -> str:
    text = cell_text(value)
    if not isinstance(value, str) and text.startswith("-"):
        text = "−" + text[1:]  # a hyphen is shorter than a minus
    return text.translate(_LATEX)


def _is_numeric(table: Table, i: int) -> bool:
    return i > 0 and not any(isinstance(row[i], str) for row in table.rows)
