"""Simulator: a system compiled once and run often, on one waveform or on many."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dcvrt.criteria import Criteria
from dcvrt.dae import Dae
from dcvrt.errors import InputError, SimulationError
from dcvrt.integrators.batch import BatchResult, only_waveform, run_batch
from dcvrt.integrators.casadi import Casadi
from dcvrt.integrators.channels import Channels, Inputs, channels
from dcvrt.integrators.corners import outputs_with_corners
from dcvrt.integrators.equations import Equations
from dcvrt.integrators.equilibrium import equilibrium, given_start
from dcvrt.integrators.model import Model
from dcvrt.integrators.run import Run
from dcvrt.trajectory import Signals, Trajectory
from dcvrt.waveform import Waveform

Array = NDArray[np.float64]


class Simulator:
    """Runs a system on waveforms, with forward sensitivities.

    Stops (input jumps, events) and samples (`save_at`) have nothing to do with each other: samples are read
    from the dense output of the steps that accuracy asks for.

    Parameters
    ----------
    dae : the system, from ``Diagram.compile()``.
    solver : :class:`~dcvrt.integrators.Casadi` options; by default the explicit pair ``erk``, or
        ``rosenbrock`` for a system with algebraic variables.
    wrt : thetas of the sensitivities: parameters, and tangents that the waveforms carry. A tangent with the
        name of a parameter adds to it.
    save_at : largest distance of samples, s.
    start : ``"equilibrium"`` at the first value of the waveform, or ``"given"``: the start values of the
        system as they are, for systems that have no rest.

    Raises
    ------
    InputError
        what is no solver, a `wrt` that stands twice, `save_at` that is not positive, a compiler that fails.
    """

    def __init__(
        self,
        dae: Dae,
        solver: Casadi | None = None,
        wrt: Sequence[str] = (),
        save_at: float = 1e-3,
        start: str = "equilibrium",
    ) -> None:
        if isinstance(wrt, str):
            raise InputError(f"wrt = {wrt!r} must be a tuple of names: wrt=({wrt!r},).")
        twice = sorted({n for n in wrt if list(wrt).count(n) > 1})
        if twice:
            raise InputError(f"wrt names {', '.join(twice)} twice.")
        if solver is not None and not isinstance(solver, Casadi):
            named = repr(solver) if isinstance(solver, str) else "..."
            raise InputError(
                f"solver = {solver!r}: must be solver options. Way out: solver=Casadi({named}), or leave it "
                "out."
            )
        if not save_at > 0:
            raise InputError(f"save_at = {save_at:g} s must be positive.")
        if start not in ("equilibrium", "given"):
            raise InputError(f"start = {start!r} must be 'equilibrium' or 'given'.")
        self.dae = dae
        self.solver = solver or Casadi("rosenbrock" if dae.z.numel() else "erk")
        self.wrt = tuple(wrt)
        self.save_at, self.start = save_at, start
        self._models: dict[bool, Model] = {}
        self._last: tuple[Any, ...] = ()

    @property
    def backend(self) -> str:
        """How the model is evaluated: compiled by what, or interpreted and why."""
        return f"casadi {self.solver.plugin}, {self._model(False).backend}"

    def __call__(self, waveform: Waveform, inputs: Inputs | None = None, **parameters: float) -> Trajectory:
        """Run on one waveform.

        Parameters
        ----------
        waveform : POI voltage; its span is the span of the run.
        inputs : samples (t, values) of other inputs, by name; without samples an input keeps its rest value.
        parameters : values that differ from the system's own; paths as ``**{"pll.K_p": 40.0}``.

        Raises
        ------
        InputError
            what is no waveform, unknown names, values outside their bounds.
        SimulationError
            no equilibrium, or the run ended before its time; the message is the status.
        """
        run = self.attempt(waveform, inputs, **parameters)
        if not run.completed:
            raise SimulationError(f"{self.dae.name} on {waveform.name}: {run.status}")
        return run

    def attempt(self, waveform: Waveform, inputs: Inputs | None = None, **parameters: float) -> Trajectory:
        """As a call, but a run that ends before its time is returned, with its status and what there is."""
        only_waveform(waveform)
        p = self.dae.parameter_values(**parameters)
        model = self._model(any(name in waveform.tangents for name in self.wrt))
        table = self._channels(model.equations, waveform, inputs)
        X, Z = self._begin(model.equations, table, p)
        run = Run(model, table, p, X, Z, self.save_at)
        status = run.run()
        return self._trajectory(model, run, status, p, waveform.name)

    def batch(
        self,
        waveforms: Sequence[Waveform],
        table: Mapping[str, float | Sequence[float]],
        criteria: Criteria | None = None,
        keep: bool = False,
    ) -> BatchResult:
        """Run many cases; failures are kept and labelled.

        Parameters
        ----------
        waveforms : one per case, or one for all.
        table : values per parameter: one number for all cases or one per case.
        criteria : adds margins and diagnostics to every row.
        keep : keep the trajectories.

        Raises
        ------
        InputError
            no waveform, what is no waveform or no criteria, columns whose lengths differ, unknown names.
        """
        return run_batch(self, waveforms, table, criteria, keep)

    # -- parts --------------------------------------------------------------------------------------------

    def _model(self, tangents: bool) -> Model:
        if tangents not in self._models:
            self._models[tangents] = Model(Equations(self.dae, self.wrt, tangents), self.solver)
        return self._models[tangents]

    def _channels(self, equations: Equations, waveform: Waveform, inputs: Inputs | None) -> Channels:
        if not self._last or self._last[0] is not waveform or self._last[1] is not inputs:
            self._last = (waveform, inputs, channels(equations, waveform, inputs))
        return self._last[2]

    def _begin(self, eq: Equations, table: Channels, p: Array) -> tuple[Array, Array]:
        """Start values with their scaled sensitivities beside them."""
        flags = np.concatenate([np.zeros(0), *(a.flags[a.mode_number(a.start)] for a in self.dae.automata)])
        if self.start == "equilibrium":
            w, slope = equilibrium(eq, table.first, p, flags, table.first_tangent)
        else:
            w, slope = given_start(eq, table.first, p, table.first_tangent)
        slope = slope * eq.scale
        return (
            np.concatenate((w[: eq.nx], slope[: eq.nx].T.ravel())),
            np.concatenate((w[eq.nx :], slope[eq.nx :].T.ravel())),
        )

    def _trajectory(self, model: Model, run: Run, status: str, p: Array, name: str) -> Trajectory:
        eq, dae = model.equations, self.dae
        t: list[Array] = []
        X: list[Array] = []
        Z: list[Array] = []
        y: list[list[Array]] = []
        for phase in run.phases:
            times, states, algebraics, signals = outputs_with_corners(run, phase)
            t.append(times)
            X.append(states)
            Z.append(algebraics)
            y.append(signals)
        all_x, all_z = np.concatenate(X), np.concatenate(Z)
        outputs = [np.concatenate(part) for part in zip(*y, strict=True)]
        sens = rate_sens = x_sens = z_sens = None
        if eq.nw:
            sens, rate_sens = outputs[2] / eq.scale, outputs[3] / eq.scale
            n = len(all_x)
            x_sens = all_x[:, eq.nx :].reshape(n, eq.nw, eq.nx).transpose(0, 2, 1) / eq.scale
            z_sens = all_z[:, eq.nz :].reshape(n, eq.nw, eq.nz).transpose(0, 2, 1) / eq.scale
        breaks = np.array(run.break_grad).reshape(len(run.break_grad), eq.nw) / (eq.scale if eq.nw else 1.0)
        return Trajectory(
            t=np.concatenate(t),
            outputs=Signals(dae.y_names, outputs[0][:, :, 0], outputs[1][:, :, 0], sens, rate_sens),
            states=Signals(dae.x_names, all_x[:, : eq.nx], None, x_sens),
            algebraics=Signals(tuple(r.path for r in dae.algebraics), all_z[:, : eq.nz], None, z_sens),
            events=tuple(run.events),
            status=status,
            parameters=dict(zip(dae.p_names, p.tolist(), strict=True)),
            wrt=self.wrt,
            start_modes={a.path: a.start for a in dae.automata},
            break_grad=breaks,
            name=name,
        )
