"""Planning: hosting capacity over all operating hours, and what ride-through takes from it."""

from __future__ import annotations

from dcvrt.planning import profiles
from dcvrt.planning.hosting import HostingProblem
from dcvrt.planning.plan import AcVerdict, Binding, Plan, Row

__all__ = ["AcVerdict", "Binding", "HostingProblem", "Plan", "Row", "profiles"]
