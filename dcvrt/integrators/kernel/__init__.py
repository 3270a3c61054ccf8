"""Our own compiled integrator: options. The parts are imported from their modules."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from dcvrt.errors import InputError, did_you_mean

METHODS = ("dp5", "rosenbrock")


@dataclass(frozen=True)
class Kernel:
    """Options of the compiled kernel: steps, events and sensitivities in one C driver.

    Parameters
    ----------
    method : ``dp5``, the explicit pair of orders 5 and 4 of Dormand and Prince with the wide region of
        stability (RK5(4)7S), for systems without algebraic variables; ``rosenbrock``, the linearly implicit,
        L-stable pair Rodas5P of orders 5 and 4, for stiff systems and those with algebraic variables
        (index 1). By default the first where it can be, else the second.
    rtol, atol : relative and absolute tolerance of every state and algebraic variable. Sensitivities take
        part in the error control with ten times the relative tolerance, against their own size and a tenth
        of their column's.
    max_steps : most steps of one run.
    threads : threads of a batch; results do not depend on it.
    """

    method: Literal["dp5", "rosenbrock"] | None = None
    rtol: float = 1e-6
    atol: float = 1e-8
    max_steps: int = 1_000_000
    threads: int = 1

    def __post_init__(self) -> None:
        if self.method is not None and self.method not in METHODS:
            raise InputError(f"The kernel has no method {self.method!r}.{did_you_mean(self.method, METHODS)}")
        for name, value in (("rtol", self.rtol), ("atol", self.atol)):
            if not 1e-14 <= value < 1:
                raise InputError(f"{name} = {value:g} must be at least 1e-14 (round-off) and below 1.")
        for name, count in (("max_steps", self.max_steps), ("threads", self.threads)):
            if count < 1:
                raise InputError(f"{name} = {count} must be at least 1.")

    def fitted(self, algebraics: int) -> Kernel:
        """These options with the method that is used for a system with so many algebraic variables.

        >>> Kernel().fitted(0).method, Kernel().fitted(2).method
        ('dp5', 'rosenbrock')
        """
        return replace(self, method=self.method or ("rosenbrock" if algebraics else "dp5"))
