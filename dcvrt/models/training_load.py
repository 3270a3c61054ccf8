"""Servers that train one large model in step: all compute, all communicate, all save at the same time."""

from __future__ import annotations

from typing import Any

from dcvrt.models.automaton import Go, above, always, below
from dcvrt.models.block import Equations, Parameter, State
from dcvrt.models.loads import ItLoad

MEASURED = "public GPU power measurements (genai-gpu-power-analysis): {}"


class TrainingLoad(ItLoad):
    r"""Demand of servers in synchronised training: steps of computing and communicating, and checkpoints.

    .. math::
        P^{IT} = \varphi_{IT}\, d\, H\, g_{IT}\, g, \qquad
        T_{edge}\, \dot g = 1 + G\left(\frac{\ell}{\bar\ell} - 1\right) - g

    .. math::
        \bar\ell = \frac{N c\,(1 - a\, b) + T_{cp}\,(1 - b_{cp})}{N c + T_{cp}}

    | mode | power l | lasts |
    |---|---|---|
    | BEGIN | 1 | phase c: computes before its first low phase |
    | COMPUTE | 1 | (1 - a) c |
    | COMMUNICATE | 1 - b | a c |
    | CHECKPOINT | 1 - b_cp | T_cp, after every N steps |

    c is the cycle, a the share of it spent low, b the depth: names and meaning as in the components of
    `dcvrt.models.workload`, without their randomness. The mean of g over N steps and a checkpoint is 1; the
    gain G scales the fluctuation. It takes the place of the servers, ``f.replace("it", TrainingLoad())``, and
    multiplies g_it; its output g can feed other blocks. The cooling of the shipped variants follows g_it: the
    mean, since its lag is longer than a cycle.
    Equilibrium: BEGIN, n = 0; a run starts there, at the power of computing.
    Differs: the paper's components have stochastic cycles; here all servers are in step, the worst case.
    """

    modes = ("BEGIN", "COMPUTE", "COMMUNICATE", "CHECKPOINT")
    start = "BEGIN"
    flags = {"communicating": (0, 0, 1, 0), "saving": (0, 0, 0, 1)}  # noqa: RUF012

    cycle = Parameter(3.5, "s", (1e-2, 600.0), "duration of a step", MEASURED.format("cycle 3.5 s"))
    low = Parameter(0.3, "1", (0.01, 0.99), "share of the step spent communicating", "illustrative")
    depth = Parameter(0.5, "1", (0.0, 1.0), "fall of the power while communicating", "illustrative")
    steps = Parameter(2.0, "1", (1.0, 1e6), "steps between checkpoints, a whole number",
                      MEASURED.format("a checkpoint about every 13 s"))  # fmt: skip
    T_cp = Parameter(6.0, "s", (1e-2, 3600.0), "duration of a checkpoint", MEASURED.format("5-7 s"))
    depth_cp = Parameter(
        0.16, "1", (0.0, 1.0), "fall of the power in a checkpoint", MEASURED.format("15-17 %")
    )
    phase = Parameter(0.5, "1", (0.0, 1.0), "time to the first low phase over the cycle", "free choice")
    gain = Parameter(1.0, "1", (0.0, 1.0), "scale of the fluctuation: 0 a constant load", "as measured")
    T_edge = Parameter(0.02, "s", (1e-4, 5.0), "time constant of the edges", "illustrative")

    g = State(1.2, "1", "multiplier of the servers' power, mean 1")
    n = State(0.0, "1", "steps done since the last checkpoint")

    def transitions(self, s: Any) -> tuple[Go, ...]:
        last = s.steps - 1.5  # between the counts before and after the last step but one
        return (
            Go("BEGIN", "COMMUNICATE", always(), held=s.phase * s.cycle),
            Go("COMPUTE", "COMMUNICATE", always(), held=(1 - s.low) * s.cycle),
            Go("COMMUNICATE", "CHECKPOINT", above(s.n, last), held=s.low * s.cycle, reset=dict(n=0)),
            Go("COMMUNICATE", "COMPUTE", below(s.n, last), held=s.low * s.cycle, reset=dict(n=s.n + 1)),
            Go("CHECKPOINT", "COMPUTE", always(), held=s.T_cp),
        )

    def equations(self, s: Any) -> Equations:
        plain = super().equations(s)
        level = 1 - s.communicating * s.depth - s.saving * s.depth_cp
        return Equations(
            der=dict(g=(self.multiplier(s, level) - s.g) / s.T_edge, n=0.0),
            out=dict(p=plain.out["p"] * s.g),
        )

    def multiplier(self, s: Any, level: Any) -> Any:
        """Power over the mean of a long record, fluctuation scaled."""
        steps = s.steps * s.cycle
        mean = (steps * (1 - s.low * s.depth) + s.T_cp * (1 - s.depth_cp)) / (steps + s.T_cp)
        return 1 + s.gain * (level / mean - 1)

    def rest(self, s: Any) -> dict[str, Any]:
        return dict(g=self.multiplier(s, 1.0), n=0.0)
