"""Sheets: what they say, and that each form is well formed."""

from __future__ import annotations

import io
import re
import unicodedata

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcvrt import facility
from dcvrt.errors import InputError
from dcvrt.models import Block, Diagram, Equations, Input, Output, Parameter, State
from dcvrt.models.declared import Declared
from dcvrt.models.expressions import text_of
from dcvrt.models.netlist import netlist
from dcvrt.models.prose import Formula, Items, Table, Text, parse
from dcvrt.models.sheet import contents
from dcvrt.models.sheet_forms import terminal
from dcvrt.models.unicode_math import readable


class Odd(Block):
    r"""Everything that is hard to print: 50 % of V_dip & #1, ``a_b``, |x| < y^2.

    .. math::
        T \dot x = \frac{u - x}{1 + k},

        y = \begin{cases} x & x > 0 \\ 0 & x \le 0 \end{cases}

    With :math:`k > 0` only.

    | mode | meaning |
    |---|---|
    | A_1 | \|V\| is high |

    - first, which goes
      on here
    - second_one

    Differs: from the paper in 100 % of the cases.

    >>> 1 + 1
    2
    """

    k = Parameter(0.5, "1", (0, 1), "gain_of 10 % & more", "own_choice #3")
    u = Input("1", "in")
    x = State(0.0, "1", "lagged", (0.0, 2.0), "x is gone")
    y = Output("1", "out")

    def equations(self, s):
        return Equations(der={"x": (s.u - s.x) / (1 + s.k)}, out={"y": s.x})


def odd():
    d = Diagram("odd_one", "a line about it")
    b = d.add("b_1", Odd())
    d.connect(d.input("u", "1"), b.u)
    d.output("y", b.y)
    return d


# ---- parts of a docstring ---------------------------------------------------------------------------------


def test_a_docstring_comes_apart_into_its_parts():
    title, one, two, only, modes, items, differs = parse(Odd.__doc__)
    assert title == Text("Everything that is hard to print: 50 % of V_dip & #1, `a_b`, |x| < y^2.")
    assert one == Formula(r"T \dot x = \frac{u - x}{1 + k},")
    assert two.tex.startswith(r"y = \begin{cases}")
    assert only == Text("With $k > 0$ only.")
    assert modes == Table(("mode", "meaning"), (("A_1", r"\|V\| is high"),))
    assert items == Items(("first, which goes on here", "second_one"))
    assert differs == Text("**Differs:** from the paper in 100 % of the cases.")


def test_sections_for_programmers_are_left_out():
    assert parse("What it is.\n\nRaises\n------\nInputError\n    always.") == [Text("What it is.")]


# ---- what a sheet says ------------------------------------------------------------------------------------


def test_a_sheet_says_what_the_diagram_is_made_of():
    text = odd().sheet()
    assert text.startswith("# odd_one\n\na line about it\n")
    assert "| `k` | 0.5 | 1 | [0, 1] | gain_of 10 % & more | own_choice #3 |" in text
    assert "| input | `u` | 1 | in | `u` |" in text
    assert "| output | `y` | 1 | out | states, parameters |" in text
    assert "| state | `x` | 1 | lagged; valid in [0, 2] |  |" in text
    assert "- **b_1**: from the paper in 100 % of the cases." in text
    assert ">>>" not in text


def test_the_page_of_a_variant_stands_at_the_top():
    d = odd()
    d.page = "What it is for.\n\n- one use\n- another"
    assert d.sheet().startswith("# odd_one\n\nWhat it is for.\n\n- one use\n- another\n")
    gfl = facility.get("gfl")
    assert gfl.page.startswith((facility.gfl.__doc__ or "").splitlines()[0])
    assert ">>>" not in gfl.sheet()


def test_feedthrough_is_shown_with_the_outputs():
    assert "| output | `i` | pu(I) | current asked for, dq frame | `v`, `delta`, `p_c`, `q_c` |" in (
        facility.gfl().sheet()
    )


def test_an_unknown_form_is_refused():
    with pytest.raises(InputError) as error:
        odd().sheet("latx")
    assert (
        str(error.value)
        == "there is no sheet in the form 'latx'. Did you mean 'latex'? Known: markdown, latex."
    )


# ---- LaTeX ------------------------------------------------------------------------------------------------

ENVIRONMENTS = {"document", "longtable", "itemize", "cases", "aligned", "matrix", "pmatrix"}


def check_latex(text: str) -> None:
    """What would stop a run of LaTeX: characters, braces, environments, delimiters of formulas, columns."""
    foreign = sorted({c for c in text if ord(c) > 126 or (ord(c) < 32 and c != "\n")})
    assert not foreign, f"characters that pdflatex does not know: {foreign}"
    preamble, _, body = text.partition(r"\begin{document}")
    assert preamble.startswith(r"\documentclass")
    body = r"\begin{document}" + body
    assert body.rstrip().endswith(r"\end{document}")
    stack: list[str] = []
    math = ""  # the delimiter that would close the formula we are in
    tokens = re.findall(
        r"\\(?:begin|end)\{\w+\*?\}|\\[A-Za-z]+\*?|\\.|[{}$_^&#%]|[^\\{}$_^&#%]+", body, re.DOTALL
    )
    assert "".join(tokens) == body
    for token in tokens:
        inside = any(e in ("cases", "aligned", "matrix", "pmatrix", "longtable") for e in stack)
        if token.startswith(r"\begin{"):
            name = token[7:-1]
            assert name in ENVIRONMENTS, token
            assert math or name not in ("cases", "aligned"), f"{token} outside a formula"
            stack.append(name)
        elif token.startswith(r"\end{"):
            assert stack, token
            assert stack.pop() == token[5:-1], token
        elif token == "{":
            stack.append("{")
        elif token == "}":
            assert stack.pop() == "{"
        elif token == "$":
            assert math in ("", "$"), "a dollar sign inside a displayed formula"
            math = "" if math else "$"
        elif token == r"\[":
            assert not math
            math = r"\]"
        elif token == r"\]":
            assert math == r"\]"
            math = ""
        elif token in ("_", "^"):
            assert math, f"{token} outside a formula"
        elif token == "&":
            assert inside, "& outside a table"
        elif token in ("#", "%"):
            raise AssertionError(f"{token} is not escaped")
        elif math and "\n\n" in token:
            raise AssertionError("an empty line inside a formula")
    assert not stack
    assert not math
    for match in re.finditer(r"\\begin\{longtable\}\{([^\n]*)\}\n(.*?)\\end\{longtable\}", body, re.DOTALL):
        columns = match[1].count("L{")
        for line in match[2].splitlines():
            if line.endswith(r"\\"):
                plain = re.sub(r"\$[^$]*\$", "", line)
                assert len(re.findall(r"(?<!\\)&", plain)) == columns - 1, line
        assert sum(float(w) for w in re.findall(r"L\{([\d.]+)", match[1])) < 1.0


def test_the_check_of_latex_can_fail():
    head = "\\documentclass{article}\n\\begin{document}\n"
    for bad in ("a_b", "50 %", r"\begin{cases} a \end{cases}", "$x", "{", r"\[ x $ \]", "a & b", "é",
                r"\begin{itemize}\end{document}\begin{document}\end{itemize}", "\\[\nx\n\n\\]"):  # fmt: skip
        with pytest.raises(AssertionError):
            check_latex(head + bad + "\n\\end{document}\n")


@pytest.mark.parametrize("name", ["odd", *facility.names()])
def test_the_latex_of_a_sheet_is_well_formed(name):
    diagram = odd() if name == "odd" else facility.get(name)
    check_latex(diagram.sheet("latex"))


def test_text_in_latex_is_escaped():
    text = odd().sheet("latex")
    assert r"gain\_of 10 \% \& more" in text
    assert r"own\_choice \#3" in text
    assert r"\texttt{a\_b}, \textbar{}x\textbar{} \textless{} y\textasciicircum{}2" in text
    assert "\\[\nT \\dot x = \\frac{u - x}{1 + k},\n\\]" in text
    assert r"\section*{odd\_one}" in text


# ---- terminal ---------------------------------------------------------------------------------------------


def printed(name, width):
    from rich.console import Console

    console = Console(width=width, record=True, file=io.StringIO())
    for part in terminal(contents(facility.get(name)), width):
        console.print(part)
    return console.export_text()


@pytest.mark.parametrize("width", [80, 120])
@pytest.mark.parametrize("name", facility.names())
def test_a_terminal_shows_no_latex_and_stays_within_its_width(name, width):
    text = printed(name, width)
    assert max(len(line) for line in text.splitlines()) <= width
    assert not re.search(r"\\[a-zA-Z]+|\$|…", text)
    # headings, symbols, units and numbers stand whole; only prose and long expressions are broken
    words = set(text.split())
    net = netlist(facility.get(name))
    for block in net.blocks.values():
        assert {*block.flags, *block.modes} <= words
        assert {*block.declared(Declared)} <= words
    for row in facility.get(name).compile().parameter_rows:
        bounds = f"[{row.bounds[0]:g}, {row.bounds[1]:g}]"
        assert re.search(
            rf"^ ?{row.path.rpartition('.')[2]} +{re.escape(f'{row.value:g}')} +{re.escape(row.unit)} +"
            rf"{re.escape(bounds)} ",
            text,
            re.MULTILINE,
        ), row.path


def test_a_narrow_terminal_shows_the_source_under_the_meaning():
    rows = [line.strip() for line in printed("gfl", 80).splitlines()]
    at = next(k for k, row in enumerate(rows) if row.startswith("V_dip "))
    assert rows[at].endswith("leave NORMAL below")
    assert rows[at + 1] == "illustrative: the paper prints none"
    assert re.search(r"V_dip .* leave NORMAL below +illustrative", printed("gfl", 120))


@pytest.mark.parametrize(
    ("tex", "text"),
    [
        (r"\frac{a + b}{c} d", "((a + b)/c) d"),
        (r"\frac{a}{b + c} + 1", "a/(b + c) + 1"),
        (r"\frac{a}{\frac{b}{c}}", "a/(b/c)"),
        (r"e^{-j\delta}", "e^(-jδ)"),
        (r"x^2 + y_{min}^{-1}", "x² + y_min⁻¹"),
        (r"\sqrt{x^2 + 1}", "√(x² + 1)"),
        (r"\operatorname{sat}_{[0,\, I]}\!\left(x\right)", "sat_{[0, I]}(x)"),
        (r"\dot\delta = \omega_B (\omega - 1), \qquad \ddot x", "δ̇ = ω_B (ω - 1),   ẍ"),
        (r"\begin{cases} a & x > 0 \\ b & x \le 0\end{cases}", "{ a   x > 0 ; b   x ≤ 0 }"),
        (r"\unknown{x}", "unknown x"),
    ],
)
def test_formulas_as_text(tex, text):
    def letters(s: str) -> str:
        return re.sub(r"\s+", " ", unicodedata.normalize("NFC", s)).replace(" ;", ";")

    assert letters(readable(tex)) == letters(text)


# ---- expressions as text ----------------------------------------------------------------------------------

a, b, c = (ca.SX.sym(n) for n in "abc")
LEAVES = st.sampled_from([a, b, c, ca.SX(2.0), ca.SX(-0.5), ca.SX(3.0)])
TREES = st.recursive(
    LEAVES,
    lambda inner: st.one_of(
        st.tuples(inner, inner).map(lambda p: p[0] + p[1]),
        st.tuples(inner, inner).map(lambda p: p[0] - p[1]),
        st.tuples(inner, inner).map(lambda p: p[0] * p[1]),
        st.tuples(inner, inner).map(lambda p: p[0] / (p[1] + 4)),
        inner.map(lambda e: -e),
        inner.map(lambda e: (1 + e * e) ** 0.5),
        inner.map(lambda e: ca.sqrt(1 + e**2)),
    ),
    max_leaves=8,
)


@given(TREES)
def test_an_expression_as_text_means_the_same(expression):
    values = {"a": 0.7, "b": -1.3, "c": 2.1}
    symbols = ca.symvar(expression)
    function = ca.Function("e", symbols, [expression])
    meant = float(function.call([values[str(s)] for s in symbols])[0])
    written = eval(text_of(expression), {"__builtins__": {}}, {**values, "sqrt": np.sqrt, "abs": abs})
    assert written == pytest.approx(meant, rel=1e-4, abs=1e-4)  # numbers are written with six digits
