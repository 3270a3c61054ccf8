"""Small systems whose runs are known in closed form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from dcvrt.dae import Automaton, Dae, Row, Transition
from dcvrt.waveform import Waveform


class Sketch:
    """Symbols of a system to be: states, algebraic variables, POI voltage, parameters, automata."""

    def __init__(
        self, states: Mapping[str, float], parameters: Mapping[str, float], algebraics: Sequence[str] = ()
    ):
        self.states, self.parameters, self.algebraics = dict(states), dict(parameters), list(algebraics)
        self.t = ca.SX.sym("t")
        self.x = {n: ca.SX.sym(n) for n in states}
        self.z = {n: ca.SX.sym(n) for n in algebraics}
        self.p = {n: ca.SX.sym(n) for n in parameters}
        self.v = ca.SX.sym("v", 2)
        self.automata: list[Automaton] = []

    def automaton(
        self, path: str, flags: Mapping[str, Sequence[float]], start: str
    ) -> tuple[ca.SX, ca.SX, list[Transition]]:
        """Flags, clock, and the list to append the rows to."""
        width = len(next(iter(flags.values())))
        q, clock = ca.SX.sym(f"{path}_q", width), ca.SX.sym(f"{path}_clock")
        rows: list[Transition] = []
        names = tuple(f"flag_{k}" for k in range(width))
        self._pending = (
            path,
            tuple(flags),
            start,
            q,
            names,
            np.array(list(flags.values()), dtype=float),
            clock,
            rows,
        )
        self.automata.append(self._pending)  # type: ignore[arg-type]
        return q, clock, rows

    def dae(
        self,
        rates: Mapping[str, object],
        outputs: Mapping[str, object],
        residuals: Sequence[object] = (),
        bounds: Mapping[str, tuple[float, float]] | None = None,
        crossing: Mapping[str, str] | None = None,
        start: Mapping[str, object] | None = None,
    ) -> Dae:
        def column(values: object) -> ca.SX:
            return ca.vertcat(ca.SX(0, 1), *[ca.SX(v) for v in values])  # type: ignore[attr-defined]

        begin = {**self.states, **dict.fromkeys(self.algebraics, 1.0), **(start or {})}
        return Dae(
            name="sketch",
            t=self.t,
            x=column(self.x.values()),
            z=column(self.z.values()),
            u=self.v,
            p=column(self.p.values()),
            f=column(rates[n] for n in self.states),
            g=column(residuals),
            y=column(outputs.values()),
            states=tuple(
                Row(n, "1", v, (bounds or {}).get(n, (-np.inf, np.inf)), crossing=(crossing or {}).get(n, ""))
                for n, v in self.states.items()
            ),
            algebraics=tuple(Row(n, "1") for n in self.algebraics),
            inputs=(Row("v_poi.re", "pu(V)", 1.0), Row("v_poi.im", "pu(V)")),
            parameter_rows=tuple(Row(n, "1", v, (-10.0, 10.0)) for n, v in self.parameters.items()),
            outputs=tuple(Row(n, "1") for n in outputs),
            automata=tuple(
                Automaton(*parts[:7], tuple(parts[7]))
                for parts in self.automata  # type: ignore[index]
            ),
            start=column(begin.values()),
        )


def go(
    source: str, target: str, guard: object, held: object = 0.0, reset: Mapping[int, object] | None = None
) -> Transition:
    """A row, labelled by its modes and its place in the test."""
    text = f"{source} -> {target}" + ("" if isinstance(held, float) and held == 0.0 else " held")
    return Transition(
        source, target, ca.SX(guard), ca.SX(held), text, {k: ca.SX(v) for k, v in (reset or {}).items()}
    )


def ball() -> Dae:
    """Ball that falls from h0 and bounces with restitution e: reset and self-transition."""
    s = Sketch({"h": 1.0, "w": 0.0}, {"g": 9.81, "e": 0.8, "h0": 1.0})
    _, _, rows = s.automaton("ball", {"falling": (1.0,)}, "falling")
    rows.append(go("falling", "falling", -s.x["h"], reset={1: -s.p["e"] * s.x["w"]}))
    return s.dae({"h": s.x["w"], "w": -s.p["g"]}, {"height": s.x["h"]}, start={"h": s.p["h0"]})


def store() -> Dae:
    """Energy E drained by P from a dip on; refilled with rate R from E_min until E_max, and again."""
    s = Sketch({"E": 1.0}, {"P": 1.0, "R": 2.0, "E_min": 0.5, "E_max": 0.8})
    q, _, rows = s.automaton("sup", {"rest": (0.0, 0.0), "drain": (1.0, 0.0), "fill": (0.0, 1.0)}, "rest")
    rows += [
        go("rest", "drain", 0.9 - s.v[0]),
        go("drain", "fill", s.p["E_min"] - s.x["E"]),
        go("fill", "drain", s.x["E"] - s.p["E_max"]),
    ]
    return s.dae({"E": -q[0] * s.p["P"] + q[1] * s.p["R"]}, {"energy": s.x["E"]})


def decay() -> Dae:
    """x' = -z, 0 = z - k x^3 - x, with a guard on the algebraic variable."""
    s = Sketch({"x": 1.0}, {"k": 0.5, "z_low": 0.6}, ["z"])
    q, _, rows = s.automaton("sup", {"fast": (1.0,), "slow": (0.25,)}, "fast")
    rows.append(go("fast", "slow", s.p["z_low"] - s.z["z"]))
    x, z = s.x["x"], s.z["z"]
    return s.dae({"x": -q[0] * z}, {"z_out": z, "x_out": x}, [z - s.p["k"] * x**3 - x])


def crossed() -> Dae:
    """Two decays whose algebraic variables change places with the mode: pivots of one are zero in the other.

    x' = -z_x, y' = -2 z_y; z_x, z_y are x, y before t_s and y, x after it.
    """
    s = Sketch({"x": 1.0, "y": 2.0}, {"t_s": 0.3}, ["z_x", "z_y"])
    q, _, rows = s.automaton("sup", {"straight": (1.0, 0.0), "crossed": (0.0, 1.0)}, "straight")
    rows.append(go("straight", "crossed", s.t - s.p["t_s"]))
    (x, y), (a, b) = s.x.values(), s.z.values()
    return s.dae(
        {"x": -a, "y": -2 * b}, {"x_out": x, "y_out": y, "a_out": a},
        [q[0] * a + q[1] * b - x, q[1] * a + q[0] * b - y],
        start={"z_x": 1.0, "z_y": 2.0},
    )  # fmt: skip


def flat(until: float = 1.0) -> Waveform:
    """Healthy voltage."""
    return Waveform.segments([(0.0, 1.0)], until=until)
