"""Simulator: a system compiled once and run often, on one waveform or on many."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from dcvrt.criteria import Criteria
from dcvrt.dae import Dae
from dcvrt.errors import InputError, ModelError, SimulationError
from dcvrt.functionals import Functional
from dcvrt.integrators.adjoint import (
    Adjoint,
    Backwards,
    adjoint_solver,
    plain,
    with_gradients,
)
from dcvrt.integrators.batch import BatchResult, only_waveform, run_batch
from dcvrt.integrators.casadi import Casadi
from dcvrt.integrators.channels import Channels, Inputs, channels
from dcvrt.integrators.compiler import find_compiler, say_interpreted
from dcvrt.integrators.corners import outputs_with_corners
from dcvrt.integrators.equations import Equations
from dcvrt.integrators.equilibrium import equilibrium, given_start, rest_point
from dcvrt.integrators.kernel import Kernel
from dcvrt.integrators.kernel.library import InputTable
from dcvrt.integrators.kernel.run import KernelModel, KernelRun
from dcvrt.integrators.model import Model
from dcvrt.integrators.recorded import RecordedRun
from dcvrt.integrators.run import Run
from dcvrt.linear import OperatingPoint
from dcvrt.trajectory import Signals, Trajectory
from dcvrt.waveform import Waveform

Array = NDArray[np.float64]
KERNEL_BY_DEFAULT = True
"""Whether a simulator without solver options runs on the compiled kernel, where there is a compiler."""


class Simulator:
    """Runs a system on waveforms, with forward sensitivities.

    Stops (input jumps, events) and samples (`save_at`) have nothing to do with each other: samples are read
    from the dense output of the steps that accuracy asks for.

    Parameters
    ----------
    dae : the system, from ``Diagram.compile()``.
    solver : :class:`~dcvrt.integrators.Kernel` or :class:`~dcvrt.integrators.Casadi` options; by default the
        kernel's explicit pair, or its linearly implicit method for a system with algebraic variables. Without
        a C compiler the kernel's place is taken by CasADi's ``erk`` or ``rosenbrock``, said aloud.
    wrt : thetas of the sensitivities: parameters, and tangents that the waveforms carry. A tangent with the
        name of a parameter adds to it.
    save_at : largest distance of samples, s.
    start : ``"equilibrium"`` at the first value of the waveform, or ``"given"``: the start values of the
        system as they are, for systems that have no rest.
    mode : ``"forward"`` carries dx/dtheta along: few thetas, every signal. ``"adjoint"`` goes back over the
        run once per functional: few functionals, any number of thetas (``wrt=dae.p_names``). Functionals and
        margins of the run have their gradients either way; an adjoint run has no ``run.sens``. It needs
        ``Casadi``, whose multistep integrator goes back.

    Raises
    ------
    InputError
        what is no solver, a `wrt` that stands twice, `save_at` that is not positive, a compiler that fails.
    """

    def __init__(
        self,
        dae: Dae,
        solver: Casadi | Kernel | None = None,
        wrt: Sequence[str] = (),
        save_at: float = 1e-3,
        start: str = "equilibrium",
        mode: str = "forward",
    ) -> None:
        if isinstance(wrt, str):
            raise InputError(f"wrt = {wrt!r} must be a tuple of names: wrt=({wrt!r},).")
        twice = sorted({n for n in wrt if list(wrt).count(n) > 1})
        if twice:
            raise InputError(f"wrt names {', '.join(twice)} twice.")
        if solver is not None and not isinstance(solver, (Casadi, Kernel)):
            named = repr(solver) if isinstance(solver, str) else "..."
            raise InputError(
                f"solver = {solver!r}: must be solver options. Way out: solver=Casadi({named}), or leave it "
                "out."
            )
        if not save_at > 0:
            raise InputError(f"save_at = {save_at:g} s must be positive.")
        if start not in ("equilibrium", "given"):
            raise InputError(f"start = {start!r} must be 'equilibrium' or 'given'.")
        if mode not in ("forward", "adjoint"):
            raise InputError(f"mode = {mode!r} must be 'forward' or 'adjoint'.")
        if mode == "adjoint":
            solver = adjoint_solver(dae, solver, tuple(wrt))
        self.dae, self.mode = dae, mode
        solver = solver or default_solver(dae)
        self.solver = solver.fitted(dae.z.numel()) if isinstance(solver, Kernel) else solver
        self.wrt = tuple(wrt)
        self.save_at, self.start = save_at, start
        self._models: dict[bool, Model] = {}
        self._kernels: dict[tuple[bool, tuple[str, ...]], KernelModel] = {}
        self._backwards: Backwards | None = None
        self._last: tuple[()] | tuple[Waveform, Channels] = ()
        self._tables: WeakKeyDictionary[Waveform, dict[bool, tuple[Channels, InputTable]]] = (
            WeakKeyDictionary()
        )

    @property
    def backend(self) -> str:
        """How the model is evaluated: compiled by what, or interpreted and why."""
        if self._on_kernel():
            return f"kernel {self.solver.method}, {self._kernel(False).backend}"  # type: ignore[union-attr]
        return f"casadi {self._casadi().plugin}, {self._model(False).backend}"

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
        tangents = any(name in waveform.tangents for name in self.wrt)
        if self._on_kernel():
            return self._attempt_on_kernel(waveform, inputs, p, tangents).trajectory(self.wrt, waveform.name)
        if self.mode == "adjoint":
            return self._attempt_adjoint(waveform, inputs, p, tangents)
        model = self._model(tangents)
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
        functionals: Mapping[str, Functional] | None = None,
    ) -> BatchResult:
        """Run many cases; failures are kept and labelled.

        Parameters
        ----------
        waveforms : one per case, or one for all.
        table : values per parameter: one number for all cases or one per case.
        criteria : adds margins and diagnostics to every row.
        keep : keep the trajectories.
        functionals : further columns, ``{"v": SustainedMinimum("v_it", 0.02)}``: each with its gradient
            (``d_v/d_beta``) and where it is active (``v_time``, ``v_kind``, ``v_tie``).

        The kernel runs the cases in the lanes of the processor, on ``Kernel(threads=...)`` threads, and
        computes functionals and margins inside; a result depends on neither lane nor thread.

        Raises
        ------
        InputError
            no waveform, what is no waveform, no criteria or no functional, columns whose lengths differ,
            unknown names, windows longer than a waveform.
        """
        return run_batch(self, waveforms, table, criteria, keep, functionals)

    def equilibrium(
        self,
        v: complex | None = None,
        inputs: Mapping[str, float] | None = None,
        modes: Mapping[str, str] | None = None,
        **parameters: float,
    ) -> OperatingPoint:
        """The point at which nothing moves, by name: where a run on a constant input would start and stay.

        Parameters
        ----------
        v : POI voltage, pu; without it the inputs have their rest values.
        inputs : values of other inputs by name.
        modes : mode of an automaton by its path, where it is not its start mode. Clocks stand at zero.
        parameters : values that differ from the system's own.

        Raises
        ------
        InputError
            unknown names, values outside their bounds.
        SimulationError
            no equilibrium: the five largest residuals by name, with the modes.

        >>> from dcvrt import facility
        >>> at = Simulator(facility.gfl().compile()).equilibrium(0.95, beta=1.3)
        >>> round(at["p_g"], 3), at.modes["sup"]
        (0.95, 'NORMAL')
        """
        return rest_point(Equations(self.dae, (), False), v, inputs, modes, parameters)

    # -- parts --------------------------------------------------------------------------------------------

    def _on_kernel(self) -> bool:
        """Whether the kernel runs this system; without a compiler CasADi does, and says so."""
        if not isinstance(self.solver, Kernel):
            return False
        if find_compiler() is None:
            say_interpreted()
            return False
        return True

    def _casadi(self) -> Casadi:
        """CasADi's solver, or the one that stands in for the kernel."""
        if isinstance(self.solver, Casadi):
            return self.solver
        implicit = self.dae.z.numel() or self.solver.method == "rosenbrock"
        return Casadi("rosenbrock" if implicit else "erk", self.solver.rtol, self.solver.atol)

    def _model(self, tangents: bool) -> Model:
        if tangents not in self._models:
            self._models[tangents] = Model(Equations(self.dae, self.wrt, tangents), self._casadi())
        return self._models[tangents]

    def _kernel(self, tangents: bool, watched: tuple[str, ...] = ()) -> KernelModel:
        if (tangents, watched) not in self._kernels:
            solver, compiler = self.solver, find_compiler()
            assert isinstance(solver, Kernel)
            assert compiler is not None
            if self.dae.z.numel() and solver.method == "dp5":
                raise ModelError(
                    f"{self.dae.name} has {self.dae.z.numel()} algebraic variable(s); the kernel's method "
                    f"{solver.method!r} takes none. Use Kernel('rosenbrock')."
                )
            equations = Equations(self.dae, self.wrt, tangents)
            self._kernels[tangents, watched] = KernelModel(equations, solver, compiler, watched)
        return self._kernels[tangents, watched]

    def _attempt_on_kernel(
        self, waveform: Waveform, inputs: Inputs | None, p: Array, tangents: bool
    ) -> KernelRun:
        kernel = self._kernel(tangents)
        table, pieces = self._table(kernel, waveform, inputs)
        if self.start == "equilibrium":
            X, Z, found = kernel.rests(p[None], table.first[None], table.first_tangent[None])
            X, Z = (X[0], Z[0]) if found[0] else self._begin(kernel.equations, table, p)
        else:
            X, Z = self._begin(kernel.equations, table, p)
        return kernel.run(pieces, p, X, Z, self.save_at)

    def _table(
        self, kernel: KernelModel, waveform: Waveform, inputs: Inputs | None = None
    ) -> tuple[Channels, InputTable]:
        """Pieces of a waveform as the kernel reads them, kept as long as the waveform lives; not kept with
        other inputs, which are the caller's to change."""
        if inputs:
            pieces = channels(kernel.equations, waveform, inputs)
            return pieces, InputTable(kernel.equations, pieces)
        known = self._tables.setdefault(waveform, {})
        tangents = kernel.equations.tangents
        if tangents not in known:
            pieces = channels(kernel.equations, waveform, None)
            known[tangents] = (pieces, InputTable(kernel.equations, pieces))
        return known[tangents]

    def _begin_all(
        self, kernel: KernelModel, tables: Sequence[Channels], P: Array
    ) -> tuple[Array, Array, dict[int, str]]:
        """Start values of many cases, and by number what is wrong with those that have none."""
        failures: dict[int, str] = {}
        if self.start == "equilibrium":
            first, tangent = (np.array([getattr(t, n) for t in tables]) for n in ("first", "first_tangent"))
            X, Z, found = kernel.rests(P, first, tangent)
            missing = np.flatnonzero(~found).tolist()
        else:
            X = np.zeros((len(P), kernel.width))
            Z = np.zeros((len(P), kernel.equations.nz * (1 + kernel.equations.nw)))
            missing = list(range(len(P)))
        without: dict[bytes, str] = {}  # faults of one operating point begin alike, and such a search is long
        for k in missing:
            at = tables[k].first.tobytes() + P[k].tobytes()
            if at not in without:
                try:
                    X[k], Z[k] = self._begin(kernel.equations, tables[k], P[k])
                    continue
                except SimulationError as error:
                    without[at] = str(error)
            failures[k] = without[at]
        return X, Z, failures

    def _attempt_adjoint(
        self, waveform: Waveform, inputs: Inputs | None, p: Array, tangents: bool
    ) -> Trajectory:
        if self._backwards is None:
            self._backwards = Backwards(Equations(self.dae, (), False), self._casadi())
            self._models[False] = Model(self._backwards.equations, self._casadi())
        named, model = Equations(self.dae, self.wrt, tangents), self._models[False]
        table = channels(named, waveform, inputs)
        w, slope = self._rest(named, table, p)
        run = RecordedRun(model, plain(named, table), p, w[: named.nx], w[named.nx :], self.save_at)
        found = self._trajectory(model, run, run.run(), p, waveform.name)
        return with_gradients(found, Adjoint(self._backwards, run, named, table, slope))

    def _channels(self, equations: Equations, waveform: Waveform, inputs: Inputs | None) -> Channels:
        if inputs:  # the caller's to change
            return channels(equations, waveform, inputs)
        if not self._last or self._last[0] is not waveform:
            self._last = (waveform, channels(equations, waveform, None))
        return self._last[1]

    def _begin(self, eq: Equations, table: Channels, p: Array) -> tuple[Array, Array]:
        """Start values with their scaled sensitivities beside them."""
        w, slope = self._rest(eq, table, p)
        slope = slope * eq.scale
        return (
            np.concatenate((w[: eq.nx], slope[: eq.nx].T.ravel())),
            np.concatenate((w[eq.nx :], slope[eq.nx :].T.ravel())),
        )

    def _rest(self, eq: Equations, table: Channels, p: Array) -> tuple[Array, Array]:
        """Start values of (x, z) and their derivative by every theta."""
        flags = np.concatenate([np.zeros(0), *(a.flags[a.mode_number(a.start)] for a in self.dae.automata)])
        if self.start == "equilibrium":
            return equilibrium(eq, table.first, p, flags, table.first_tangent)
        return given_start(eq, table.first, p, table.first_tangent)

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
        if isinstance(run, RecordedRun):
            run.samples = tuple(zip(t, X, Z, strict=True))
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
            algebraics=Signals(dae.z_names, all_z[:, : eq.nz], None, z_sens),
            events=tuple(run.events),
            status=status,
            parameters=dict(zip(dae.p_names, p.tolist(), strict=True)),
            wrt=self.wrt,
            start_modes={a.path: a.start for a in dae.automata},
            break_grad=breaks,
            name=name,
        )


def default_solver(dae: Dae) -> Casadi | Kernel:
    """Solver of a simulator that was told none."""
    if KERNEL_BY_DEFAULT and find_compiler() is not None:
        return Kernel()
    return Casadi("rosenbrock" if dae.z.numel() else "erk")
