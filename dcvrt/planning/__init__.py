"""Planning: hosting capacity over all operating hours, and what ride-through takes from it."""

from __future__ import annotations

from dcvrt.planning import profiles
from dcvrt.planning.hosting import HostingProblem
from dcvrt.planning.objective import MaxMin, MaxTotal, Rating
from dcvrt.planning.plan import AcVerdict, Binding, Plan, Row
from dcvrt.planning.security import N1

__all__ = [
    "N1",
    "AcVerdict",
    "Binding",
    "HostingProblem",
    "MaxMin",
    "MaxTotal",
    "Plan",
    "Rating",
    "Row",
    "profiles",
]
