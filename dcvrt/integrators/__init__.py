"""Integration: the Simulator, and the solvers behind it."""

from __future__ import annotations

from dcvrt.integrators.batch import BatchResult
from dcvrt.integrators.casadi import Casadi
from dcvrt.integrators.compiler import NoCompilerWarning, find_compiler
from dcvrt.integrators.kernel import Kernel
from dcvrt.integrators.simulator import Simulator

__all__ = ["BatchResult", "Casadi", "Kernel", "NoCompilerWarning", "Simulator", "find_compiler"]
