"""Formulas for a terminal: LaTeX as a line of Unicode text that still says the same.

Fractions and exponents keep their parentheses, so that nothing is read another way than it is meant. What is
not known is left as its name.
"""

from __future__ import annotations

import re
import unicodedata

LETTERS = ("alpha", "beta", "gamma", "delta", "epsilon", "zeta", "eta", "theta", "iota", "kappa", "lambda",
           "mu", "nu", "xi", "pi", "rho", "sigma", "tau", "phi", "chi", "psi", "omega")  # fmt: skip
GREEK = {
    name: unicodedata.lookup(f"GREEK {size} LETTER {letter.replace('lambda', 'lamda').upper()}")
    for letter in LETTERS
    for name, size in ((letter, "SMALL"), (f"var{letter}", "SMALL"), (letter.capitalize(), "CAPITAL"))
}
SYMBOLS = GREEK | {
    "qquad": ",   ", "quad": "  ", ",": " ", ";": " ", ":": " ", " ": " ", "!": "", "star": "*", "ast": "*",
    "cdot": "·", "times": "×", "pm": "±", "mp": "∓", "le": "≤", "leq": "≤", "ge": "≥", "geq": "≥", "ne": "≠",
    "neq": "≠", "approx": "≈", "to": "→", "rightarrow": "→", "infty": "∞", "sum": "Σ", "int": "∫", "in": "∈",
    "partial": "∂", "ell": "ℓ", "circ": "°", "angle": "∠", "wedge": "and", "vee": "or", "Delta": "Δ",
    "ldots": "...", "dots": "...", "cdots": "...", "{": "{", "}": "}", "%": "%", "_": "_", "|": "|",
    "lvert": "|", "rvert": "|", "colon": ":",
}  # fmt: skip
ACCENTS = {"dot": "\u0307", "ddot": "\u0308", "bar": "\u0304", "hat": "\u0302", "tilde": "\u0303",
           "overline": "\u0304", "vec": "\u20d7", "underline": "\u0332"}  # fmt: skip
PLAIN = {"operatorname", "text", "mathrm", "mathit", "mathbf", "mathsf", "textrm", "mathcal", "boldsymbol"}
RAISED = str.maketrans("0123456789+-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁺⁻")
OPEN, CLOSE = "\ue000", "\ue001"
"""Around a fraction, until it is known whether a factor follows."""
_TOKEN = re.compile(r"\\[A-Za-z]+\*?|\\.|[{}^_&]|\s+|[A-Za-z]|\d+(?:\.\d+)?|.", re.DOTALL)


def readable(tex: str) -> str:
    r"""A formula as text.

    >>> readable(r"I^u = \frac{V - E e^{j\delta}}{Z_v}, \qquad \dot\xi = K_p e^2")
    'I^u = (V - E e^(jδ))/Z_v,   ξ̇ = K_p e²'
    >>> readable(r"y = \operatorname{sat}_{\pm I}\frac{a - b}{c} + \frac{R + jX}{H} I")
    'y = sat_{± I}((a - b)/c) + ((R + jX)/H) I'
    >>> readable(r"i_q' = \operatorname{sat}_{\pm\sqrt{I^2 - i_p'^2}}(i_q)")
    "i_q' = sat_{±√(I² - i_p'²)}(i_q)"
    """
    reader = _Reader([t for t in _TOKEN.findall(tex)])
    text = reader.until(None)
    text = re.sub(rf"{OPEN}([^{OPEN}{CLOSE}]*){CLOSE}(?=\s*([^\s=+\-)\]}},;]))", r"(\1)", text)
    text = re.sub(f"[{OPEN}{CLOSE}]", "", text)
    text = re.sub(r"\s*,\s*,   ", ",   ", text)
    return re.sub(r" {4,}", "   ", re.sub(r"(?<! ) {2}(?! )", " ", text)).strip()


class _Reader:
    """Goes through the tokens of a formula."""

    def __init__(self, tokens: list[str]) -> None:
        self.tokens, self.at = tokens, 0
        self.function = False  # whether what was read last is a function that waits for its argument

    def until(self, end: str | None) -> str:
        """Text up to a closing token, which is taken; None reads to the end."""
        out: list[str] = []
        while self.at < len(self.tokens):
            if self.tokens[self.at] == end:
                self.at += 1
                break
            self._next(out)
        return "".join(out)

    def argument(self) -> str:
        """The next group, or the next token."""
        while self.at < len(self.tokens) and self.tokens[self.at].isspace():
            self.at += 1
        if self.at >= len(self.tokens):
            return ""
        if self.tokens[self.at] == "{":
            self.at += 1
            return self.until("}")
        out: list[str] = []
        self._next(out)
        return "".join(out)

    def _next(self, out: list[str]) -> None:
        token = self.tokens[self.at]
        self.at += 1
        name = token[1:] if token.startswith("\\") else ""
        waiting = self.function
        self.function = waiting and (token in ("_", "^", "\\!") or token.isspace())
        if token == "{":
            out.append(self.until("}"))
            self.function = False
        elif token == "^":
            out.append(_raised(self.argument()))
            self.function = waiting
        elif token == "_":
            out.append(_lowered(self.argument()))
            self.function = waiting
        elif token == "&":
            out.append("  ")
        elif token == "\\\\":
            out.append("; ")
        elif token.isspace():
            out.append(" ")
        elif not name:
            out.append(token)
        elif name in ("frac", "tfrac", "dfrac"):
            over, under = self.argument(), self.argument()
            fraction = f"{_whole(over)}/{_whole(under, division=True)}"
            out.append(f"({fraction})" if waiting else f"{OPEN}{fraction}{CLOSE}")
        elif name == "sqrt":
            out.append(f"√({self.argument()})")
        elif name in ACCENTS:
            inner = self.argument()
            out.append(inner[:1] + ACCENTS[name] + inner[1:])
        elif name in PLAIN:
            word = self.argument()
            self.function = name == "operatorname"
            if self.function and "".join(out)[-1:].isalnum():
                out.append(" ")
            out.append(word)
        elif name in ("begin", "end"):
            environment = self.argument()
            if environment == "cases":
                out.append("{ " if name == "begin" else " }")
        elif name in ("left", "right", "big", "Big", "bigl", "bigr", "displaystyle", "limits"):
            if self.at < len(self.tokens) and self.tokens[self.at] == ".":
                self.at += 1
        else:
            if name in SYMBOLS:
                out.append(SYMBOLS[name])
                return
            self.function = True
            if "".join(out)[-1:].isalnum():
                out.append(" ")
            out.append(name)
            if self.at < len(self.tokens) and re.match(r"[\w{]|\\[A-Za-z]", self.tokens[self.at]):
                out.append(" ")


def _whole(text: str, division: bool = False) -> str:
    """Text in parentheses where a division next to it would otherwise take only a part of it."""
    text = re.sub(f"{OPEN}(.*){CLOSE}", r"(\1)", text)
    simple = re.fullmatch(r"[^\s+\-/·×=]+", text) or re.fullmatch(r"[√Σ]?\([^()]*\)", text)
    product = not division and re.fullmatch(r"[^+\-/=]+", text)
    return text if simple or product else f"({text})"


def _raised(text: str) -> str:
    if re.fullmatch(r"[-+]?\d+", text):
        return text.translate(RAISED)
    if text in ("*", "'"):
        return text
    return f"^{text}" if re.fullmatch(r"[A-Za-z0-9_*,]+", text) else f"^({text})"


def _lowered(text: str) -> str:
    return f"_{text}" if re.fullmatch(r"[^\W_]+(?:, ?[^\W_]+)*|\+", text) else f"_{{{text}}}"
