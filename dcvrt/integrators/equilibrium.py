r"""Where a run starts: the equilibrium at the first value of the waveform.

Solves f = 0, g = 0 in (x, z) at fixed inputs by a damped Newton method whose steps have least norm, from the
start values of the system. Directions that the equations leave open (a state of charge at zero battery power)
keep their start values. With J = d(f, g)/d(x, z) and its pseudo-inverse J^+,

.. math::
    \frac{d(x, z)}{d\theta} = -J^+ (f, g)_\theta + (1 - J^+ J)\, \mathrm{start}_\theta .
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dcvrt.errors import SimulationError
from dcvrt.integrators.equations import Equations

Array = NDArray[np.float64]
RANK_TOLERANCE = 1e-10
RESIDUAL_TOLERANCE = 1e-9
ROUGH, POLISH = 1e-3, 2
"""Below this residual Newton's method is quadratic: so many full steps take it to round-off."""
MAX_ITERATIONS = 60


def equilibrium(equations: Equations, u: Array, p: Array, q: Array, u_theta: Array) -> tuple[Array, Array]:
    """Find (x, z) at rest and its derivative by every theta.

    Parameters
    ----------
    u, p, q : inputs, parameters and flags of the start modes.
    u_theta : derivative of the inputs by every theta, (inputs, thetas).

    Returns
    -------
    w : (x, z) stacked.
    w_theta : (states and algebraic variables, thetas), not scaled.

    Raises
    ------
    SimulationError
        no equilibrium was found; the five largest residuals are named.
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
            if cut < 1e-6:
                _fail(equations, residual[:, 0])
        w = w + cut * step
        undamped += cut == 1.0 and size < ROUGH
        residual, jacobian, by_pu = (np.array(m) for m in trial)
        size = np.abs(residual).max(initial=0.0)
    if not size < RESIDUAL_TOLERANCE:
        _fail(equations, residual[:, 0])
    inverse = _pseudo_inverse(jacobian)
    open_directions = np.eye(len(w)) - inverse @ jacobian
    w_theta = -inverse @ _by_theta(equations, by_pu, u_theta) + open_directions @ _by_theta(
        equations, start_pu, u_theta
    )
    return w, w_theta


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


def _fail(equations: Equations, residual: Array) -> None:
    dae = equations.dae
    names = [*(f"d({n})/dt" for n in dae.x_names), *(f"residual of {r.path}" for r in dae.algebraics)]
    order = sorted(
        range(len(names)), key=lambda k: -abs(residual[k]) if np.isfinite(residual[k]) else -np.inf
    )
    worst = "\n".join(f"  {names[k]} = {residual[k]:.3g}" for k in order[:5])
    raise SimulationError(
        f"{dae.name}: no equilibrium at the first value of the waveform. Largest residuals:\n{worst}\n"
        "Check that the facility can import its load before the disturbance (beta V must exceed the load "
        "factor d), and the start values."
    )
