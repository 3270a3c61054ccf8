r"""Where a run starts: the equilibrium at the first value of the waveform.

Solves f = 0, g = 0 in (x, z) at fixed inputs by a damped Newton method whose steps have least norm, from the
start values of the system. Directions that the equations leave open (a state of charge at zero battery power)
keep their start values. With J = d(f, g)/d(x, z) and its pseudo-inverse J^+,

.. math::
    \frac{d(x, z)}{d\theta} = -J^+ (f, g)_\theta + (1 - J^+ J)\, \mathrm{start}_\theta .
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from dcvrt.dae import Dae
from dcvrt.errors import InputError, SimulationError, did_you_mean
from dcvrt.integrators.equations import Equations
from dcvrt.linear import OperatingPoint, chosen_modes

Array = NDArray[np.float64]
RANK_TOLERANCE = 1e-10
RESIDUAL_TOLERANCE = 1e-9
ROUGH, POLISH = 1e-3, 2
"""Below this residual Newton's method is quadratic: so many full steps take it to round-off."""
MAX_ITERATIONS = 60
STUCK = 1e-4
"""A search that may go no further than this share of a step of Newton ends: it stands where the residual is
least, at limits that exclude each other or at a fold."""


def equilibrium(
    equations: Equations,
    u: Array,
    p: Array,
    q: Array,
    u_theta: Array,
    where: str = "at the first value of the waveform",
) -> tuple[Array, Array]:
    """Find (x, z) at rest and its derivative by every theta.

    Parameters
    ----------
    u, p, q : inputs, parameters and flags of the start modes.
    u_theta : derivative of the inputs by every theta, (inputs, thetas).
    where : which inputs these are, for the error.

    Returns
    -------
    w : (x, z) stacked.
    w_theta : (states and algebraic variables, thetas), not scaled.

    Raises
    ------
    SimulationError
        no equilibrium was found; the modes and the five largest residuals are named.
    """
    start, start_pu = (np.array(m) for m in equations.start(u, p))
    w = start[:, 0]
    residual, jacobian, by_pu = (np.array(m) for m in equations.rest(w, u, p, q))
    size, undamped = np.abs(residual).max(initial=0.0), 0
    for _ in range(MAX_ITERATIONS):
        if size < RESIDUAL_TOLERANCE and undamped >= POLISH:
            break
        step = -_pseudo_inverse(jacobian) @ residual[:, 0]
        cut = 1.0
        while True:
            trial = equations.rest(w + cut * step, u, p, q)
            new = np.abs(np.array(trial[0])).max(initial=0.0)
            if new <= (1 - 0.25 * cut) * size or new < RESIDUAL_TOLERANCE:
                break
            cut /= 2
            if cut < STUCK:
                _fail(equations, residual[:, 0], q, where)
        w = w + cut * step
        undamped += cut == 1.0 and size < ROUGH
        residual, jacobian, by_pu = (np.array(m) for m in trial)
        size = np.abs(residual).max(initial=0.0)
    if not size < RESIDUAL_TOLERANCE:
        _fail(equations, residual[:, 0], q, where)
    inverse = _pseudo_inverse(jacobian)
    open_directions = np.eye(len(w)) - inverse @ jacobian
    w_theta = -inverse @ _by_theta(equations, by_pu, u_theta) + open_directions @ _by_theta(
        equations, start_pu, u_theta
    )
    return w, w_theta


def rest_point(
    equations: Equations,
    v: complex | None,
    inputs: Mapping[str, float] | None,
    modes: Mapping[str, str] | None,
    parameters: Mapping[str, float],
) -> OperatingPoint:
    """The point at rest: see :meth:`Simulator.equilibrium`."""
    dae = equations.dae
    u = np.array([row.value for row in dae.inputs], dtype=float)
    named = []
    if v is not None:
        if equations.voltage is None:
            raise InputError(
                f"{dae.name} has no phasor input for v = {v:g}. Way out: inputs={{name: value}}."
            )
        re, im = equations.voltage
        u[re], u[im] = complex(v).real, complex(v).imag
        named.append(f"{dae.u_names[re].removesuffix('.re')} = {v:g}")
    for name, value in (inputs or {}).items():
        if name not in dae.u_names:
            raise InputError(f"{dae.name} has no input {name!r}.{did_you_mean(name, dae.u_names)}")
        u[dae.u_names.index(name)] = value
        named.append(f"{name} = {value:g}")
    p = dae.parameter_values(**parameters)
    chosen = chosen_modes(dae, modes)
    x, z = np.zeros(equations.nx), np.zeros(equations.nz)
    flags = OperatingPoint(dae, x, z, u, p, chosen).flags
    where = f"at {', '.join(named)}" if named else "at the rest values of the inputs"
    w, _ = equilibrium(equations, u, p, flags, np.zeros((equations.nu, equations.nw)), where)
    return OperatingPoint(dae, w[: equations.nx], w[equations.nx :], u, p, chosen)


def given_start(equations: Equations, u: Array, p: Array, u_theta: Array) -> tuple[Array, Array]:
    """Start values of the system as they are, and their derivative."""
    start, start_pu = (np.array(m) for m in equations.start(u, p))
    return start[:, 0], _by_theta(equations, start_pu, u_theta)


def _by_theta(equations: Equations, by_pu: Array, u_theta: Array) -> Array:
    """Derivative by theta from the derivative by (p, u)."""
    result = by_pu[:, equations.np :] @ u_theta
    for j, column in enumerate(equations.columns):
        if column.parameter is not None:
            result[:, j] += by_pu[:, column.parameter]
    return result


def _pseudo_inverse(jacobian: Array) -> Array:
    """Pseudo-inverse after scaling rows to unit size, so that a fast state does not hide a slow one."""
    if not np.isfinite(jacobian).all():
        return np.zeros(jacobian.T.shape)
    scale = np.abs(jacobian).max(axis=1, initial=0.0)
    scale[scale == 0.0] = 1.0
    return np.linalg.pinv(jacobian / scale[:, None], rcond=RANK_TOLERANCE) / scale


def _fail(equations: Equations, residual: Array, q: Array, where: str) -> None:
    dae = equations.dae
    names = [*(f"d({r.path})/dt" for r in dae.states), *(f"residual of {r.path}" for r in dae.algebraics)]
    units = [*(f"{r.unit}/s" for r in dae.states), *("" if r.unit == "1" else r.unit for r in dae.algebraics)]
    size = np.where(np.isfinite(residual), np.abs(residual), np.inf)
    order = sorted(range(len(names)), key=lambda k: -size[k])
    worst = "\n".join(f"  {names[k]} = {residual[k]:.3g} {units[k]}".rstrip() for k in order[:5])
    modes = _modes_of(dae, q)
    mode = f" in mode {modes}" if modes else ""
    raise SimulationError(
        f"{dae.name}: no equilibrium {where}. Largest residuals{mode}:\n{worst}\n"
        "Ways out: parameters or an input at which these equations can all be zero (a facility must be able "
        "to import its load before the disturbance: beta |V| above the load factor d); better start values "
        "(State(start), rest()); start='given' for a system that never rests."
    )


def _modes_of(dae: Dae, q: Array) -> str:
    """Modes that the flags belong to: ``sup NORMAL, cooling RUNNING``."""
    names, at = [], 0
    for a in dae.automata:
        own = q[at : at + a.flags.shape[1]]
        at += a.flags.shape[1]
        fitting = [mode for k, mode in enumerate(a.modes) if (a.flags[k] == own).all()]
        names.append(f"{a.path} {a.start if a.start in fitting else '/'.join(fitting)}")
    return ", ".join(names)
