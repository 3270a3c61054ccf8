"""Emitted C against CasADi's own evaluation, and sine and cosine against libm."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from dcvrt.errors import ModelError
from dcvrt.integrators import find_compiler
from dcvrt.integrators.compiler import build, native_flags
from dcvrt.integrators.kernel.build import FLAGS, QUIET
from dcvrt.integrators.kernel.emit import CALLS, INFIX, NAMES, Argument, Program

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")
DRIVER = Path(__file__).resolve().parents[2] / "dcvrt" / "integrators" / "kernel" / "driver"

UNARY: list[Callable[[ca.SX], ca.SX]] = [
    lambda a: -a, lambda a: a * a, lambda a: 2 * a, lambda a: 1 / (a + 3), ca.sin, ca.cos, ca.fabs, ca.sign,
    lambda a: ca.sqrt(a * a + 0.3), lambda a: ca.exp(0.3 * a), lambda a: ca.log(a * a + 0.5), ca.tanh,
    lambda a: ca.tan(0.2 * a), lambda a: ca.asin(0.3 * ca.sin(a)), lambda a: ca.acos(0.3 * ca.cos(a)),
    ca.atan,
    lambda a: ca.sinh(0.3 * a), lambda a: ca.cosh(0.3 * a), ca.asinh, lambda a: ca.acosh(1.5 + a * a),
    lambda a: ca.atanh(0.4 * ca.sin(a)), ca.floor, ca.ceil, ca.erf, lambda a: ca.log1p(a * a), ca.logic_not,
    lambda a: ca.expm1(0.2 * a), lambda a: a**3, lambda a: (a * a + 1) ** 2.7, lambda a: (a * a + 1) ** -1.5,
    lambda a: (a * a + 0.1) ** 0.5, lambda a: (a + 3.5) ** -2,
]  # fmt: skip
BINARY: list[Callable[[ca.SX, ca.SX], ca.SX]] = [
    lambda a, b: a + b, lambda a, b: a - b, lambda a, b: a * b, lambda a, b: a / (b * b + 0.7), ca.fmin,
    ca.fmax, lambda a, b: a < b, lambda a, b: a <= b, lambda a, b: a == b, lambda a, b: a != b, ca.logic_and,
    ca.logic_or, ca.atan2, ca.hypot, ca.copysign, lambda a, b: ca.fmod(a, b * b + 0.9),
    lambda a, b: (a * a + 0.5) ** b, lambda a, b: ca.if_else(a > b, a, b * b),
]  # fmt: skip


def expressions(symbols: list[ca.SX], count: int, seed: int) -> list[ca.SX]:
    """Random expressions over all operations, deep enough that classes mix."""
    rng = np.random.default_rng(seed)
    pool = [*symbols, ca.SX(0.5), ca.SX(-2.0)]
    made = []
    for k in range(count):
        a, b = (pool[i] for i in rng.integers(len(pool), size=2))
        choose = k % (len(UNARY) + len(BINARY))
        e = UNARY[choose](a) if choose < len(UNARY) else BINARY[choose - len(UNARY)](a, b)
        e = ca.atan(e) * 1.7 + a if choose < len(UNARY) else e  # keeps values of a moderate size
        made.append(e)
        pool.append(ca.sin(e) + 0.1 * b if k % 3 else e)
        pool = pool[-40:]
    return made


HARNESS = """
#include "lanes.h"
#include "equations.h"
void at_{name}(const double *p, const double *sp, const double *x, const double *xs, double *f, double *fs) {{
  real P[3], X[4], m[{fixed}], F[{rows}];
  column SP[GROUPS * 2], XS[GROUPS * 4], mc[GROUPS * {columns}], FS[GROUPS * {rows}];
  for (int k = 0; k < 3; k++) for (int l = 0; l < LANES; l++) AT(P[k], l) = p[3 * l + k];
  for (int k = 0; k < 4; k++) for (int l = 0; l < LANES; l++) AT(X[k], l) = x[4 * l + k];
  for (int l = 0; l < LANES; l++) for (int j = 0; j < NW; j++) {{
    int g = LANES == 1 ? j / COLUMNS : j, e = LANES == 1 ? j % COLUMNS : l;
    for (int k = 0; k < 2; k++) AT(SP[g * 2 + k], e) = sp[(l * NW + j) * 2 + k];
    for (int k = 0; k < 4; k++) AT(XS[g * 4 + k], e) = xs[(l * NW + j) * 4 + k];
  }}
  hoist(P, SP, m, mc);
  struct point at = {{.x = X, .xs = XS, .m = m, .mc = mc}};
  values(&at, F, FS);
  for (int l = 0; l < LANES; l++) for (int k = 0; k < {rows}; k++) {{
    f[l * {rows} + k] = AT(F[k], l);
    for (int j = 0; j < NW; j++) {{
      int g = LANES == 1 ? j / COLUMNS : j, e = LANES == 1 ? j % COLUMNS : l;
      fs[(l * NW + j) * {rows} + k] = AT(FS[g * {rows} + k], e);
    }}
  }}
}}
int lanes_{name}(void) {{ return LANES; }}
"""


@pytest.mark.parametrize("seed", [1, 2])
def test_emitted_functions_are_casadis_own(seed: int) -> None:
    """Every operation, in all classes: fixed, moving, and columns of both; on one lane and on many."""
    thetas, count = 3, 160
    p, x, sp, xs = ca.SX.sym("p", 3), ca.SX.sym("x", 4), ca.SX.sym("sp", 2), ca.SX.sym("xs", 4)
    fixed = expressions(ca.vertsplit(p), 50, seed)
    made = expressions([*ca.vertsplit(x), *fixed[::5]], count, seed + 10)
    f = ca.vertcat(*made)
    smooth = ca.vertcat(*(e for k, e in enumerate(made)))
    fs = ca.jtimes(smooth, ca.vertcat(x, p), ca.vertcat(xs, sp, 0))
    program = Program(
        [
            Argument("p", p, fixed=True), Argument("sp", sp, fixed=True, column=True),
            Argument("x", x), Argument("xs", xs, column=True),
        ],
        {"values": [("f", f), ("fs", fs)]},
        columns=["fs"],
    )  # fmt: skip
    used = {v.op for v in program.values}
    assert {NAMES[op] for op in (set(INFIX) | set(CALLS)) - used} <= {"OP_CONSTPOW"}  # which SX writes as POW
    sizes = {k: max(v, 1) for k, v in program.sizes.items()}
    text = program.hoisting("hoist") + program.function("values")
    compiler = find_compiler()
    assert compiler is not None
    units = {}
    for name, lanes in (("one", "#define LANES 1\n"), ("many", '#include "width.h"\n')):
        body = HARNESS.format(name=name, rows=count, fixed=sizes["fixed"], columns=sizes["fixed_columns"])
        units[f"{name}.c"] = f"{lanes}#define NW {thetas}\n#define COLUMNS 2\n" + body
    headers = {n: (DRIVER / n).read_text() for n in ("lanes.h", "width.h")}
    path = build(
        {**headers, **units, "equations.h": text}, compiler, (*FLAGS, "-O1", *native_flags(compiler), *QUIET),
        tuple(units),
    )  # fmt: skip
    dll = ctypes.CDLL(str(path))
    reference = ca.Function("reference", [x, p, xs, sp], [f, fs])
    rng = np.random.default_rng(seed)
    for name in units:
        lanes = getattr(dll, f"lanes_{name[:-2]}")()
        call = getattr(dll, f"at_{name[:-2]}")
        for _ in range(20):
            P, X = rng.uniform(-2, 2, (lanes, 3)), rng.uniform(-2, 2, (lanes, 4))
            SP, XS = rng.normal(size=(lanes, thetas, 2)), rng.normal(size=(lanes, thetas, 4))
            F, FS = np.zeros((lanes, count)), np.zeros((lanes, thetas, count))
            call(*(a.ctypes.data_as(ctypes.c_void_p) for a in (P, SP, X, XS, F, FS)))
            for lane in range(lanes):
                for j in range(thetas):
                    want, want_s = (
                        np.array(r)[:, 0] for r in reference(X[lane], P[lane], XS[lane, j], SP[lane, j])
                    )
                    assert F[lane] == pytest.approx(want, rel=1e-9, abs=1e-9, nan_ok=True)
                    size = np.abs(want_s[np.isfinite(want_s)]).max()
                    assert FS[lane, j] == pytest.approx(want_s, rel=1e-7, abs=1e-9 * size, nan_ok=True)


def test_an_operation_without_c_text_is_named() -> None:
    x = ca.SX.sym("x")
    odd = ca.Function("odd", [x], [ca.SX(x)])
    assert odd.n_instructions() > 0
    program = Program([Argument("x", x)], {"f": [("r", ca.sin(x))]})
    with pytest.raises(ModelError, match=r"the operation OP_LIFT has no C text\. Way out: "):
        program._operation(ca.OP_LIFT, 0, 0)


def test_repeated_and_fixed_divisors_are_divided_by_once() -> None:
    p, x = ca.SX.sym("p"), ca.SX.sym("x", 3)
    f = ca.vertcat(x[0] / p, x[1] / p, x[0] / x[2], x[1] / x[2], x[1] / (x[0] + 2))
    program = Program([Argument("p", p, fixed=True), Argument("x", x)], {"f": [("r", f)]})
    text = program.function("f")
    assert text.count("/") - text.count("*/") == 2  # 1/x[2], and one quotient that stands alone
    assert program.hoisting("hoist").count("1.0 / ") == 1


TRIG = """
#define COLUMNS 1
#define NW 0
#include "lanes.h"
void sines(long n, const double *a, double *s, double *c) {
  for (long k = 0; k + LANES <= n; k += LANES) {
    real x; for (int l = 0; l < LANES; l++) AT(x, l) = a[k + l];
    real y = sine(x), z = cosine(x);
    for (int l = 0; l < LANES; l++) s[k + l] = AT(y, l), c[k + l] = AT(z, l);
  }
}
"""


@pytest.mark.parametrize("lanes", ["#define LANES 1\n", '#include "width.h"\n'], ids=["one lane", "lanes"])
def test_sine_and_cosine_are_within_two_units_in_the_last_place(lanes: str) -> None:
    compiler = find_compiler()
    assert compiler is not None
    files = {n: (DRIVER / n).read_text() for n in ("lanes.h", "width.h")} | {"trig.c": lanes + TRIG}
    path = build(files, compiler, (*FLAGS, *native_flags(compiler), *QUIET), ("trig.c",))
    rng = np.random.default_rng(0)
    small = np.linspace(-10, 10, 64_000)
    near = np.arange(-400, 400)[:, None] * np.pi / 4 + 1e-9 * np.array([0.0, 1.0, -1.0, 30.0])
    big = rng.uniform(-9e5, 9e5, 16_000)
    far = 10.0 ** rng.uniform(6, 15, 1_600)
    tiny = 10.0 ** rng.uniform(-300, -8, 1_600)
    a = np.concatenate((small, near.ravel(), big, far, tiny))
    s, c = np.zeros_like(a), np.zeros_like(a)
    pointers = (x.ctypes.data_as(ctypes.c_void_p) for x in (a, s, c))
    ctypes.CDLL(str(path)).sines(ctypes.c_long(len(a)), *pointers)
    for ours, libm in ((s, np.sin(a)), (c, np.cos(a))):
        units = np.abs(ours - libm) / np.spacing(np.abs(libm))
        assert units.max() <= 2.0
    odd = np.array([np.nan, np.inf, -np.inf, 0.0, -0.0, np.nan, np.inf, 1.0])
    s, c = np.zeros_like(odd), np.zeros_like(odd)
    pointers = (x.ctypes.data_as(ctypes.c_void_p) for x in (odd, s, c))
    ctypes.CDLL(str(path)).sines(ctypes.c_long(len(odd)), *pointers)
    with np.errstate(invalid="ignore"):
        assert s == pytest.approx(np.sin(odd), nan_ok=True)
        assert c == pytest.approx(np.cos(odd), nan_ok=True)
