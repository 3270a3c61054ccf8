"""What is asked of every case of a batch: functionals, and margins by way of the functionals under them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from dcvrt.criteria import Criteria, Margins, longest_window, margins_of, needed, only_criteria
from dcvrt.curve import SAME_LENGTH, too_short
from dcvrt.errors import InputError, SimulationError
from dcvrt.functionals import Functional, Outcome, check_functionals

UNDER_CRITERIA = "criteria: "
"""Begins the names of functionals that only the criteria ask for; no column has such a name."""
WITH_GRADIENT = ("voltage", "import", "held_import")
"""Functionals under the criteria whose gradient margins need; of the others the value is enough."""
COLUMNS = ("waveform", "status")
COLUMNS_OF_MARGINS = (
    "voltage", "loss", "v_it_min", "time_below", "loss_share", "loss_pu", "peak_loss_share",
    "recovery_time", "bess_energy", "peak_loading", "preload", "recovered", "sequence",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Asked:
    """Functionals and criteria of a batch, checked.

    Attributes
    ----------
    criteria : None if no margins are asked for.
    functionals : what the user asked for, by name of column.
    everything : these and the ones under the criteria, by name: what a run has to compute.
    values_only : names of those whose gradient is of no use.
    """

    criteria: Criteria | None
    functionals: Mapping[str, Functional]
    everything: Mapping[str, Functional]
    values_only: frozenset[str]

    @classmethod
    def of(
        cls,
        criteria: Criteria | None,
        functionals: Mapping[str, Functional] | None,
        outputs: tuple[str, ...],
        parameters: tuple[str, ...],
        span: float,
    ) -> Asked:
        """Check what is asked of runs that last `span` or longer, of a system with these outputs.

        Raises
        ------
        InputError
            what are no criteria or functionals, unknown outputs, windows longer than a run, a name that is
            another column's.
        """
        wanted = {} if functionals is None else functionals
        check_functionals(wanted, outputs, span, "batch")
        taken = {*COLUMNS, *parameters, *(COLUMNS_OF_MARGINS if criteria is not None else ())}
        twice = [repr(name) for name in wanted if name in taken]
        if twice:
            raise InputError(
                f"batch: functionals with the name of another column: {', '.join(twice)}. "
                "Way out: other names."
            )
        if criteria is None:
            return cls(None, wanted, wanted, frozenset())
        only_criteria(criteria)
        under = {UNDER_CRITERIA + name: f for name, f in needed(criteria, outputs).items()}
        lacking = sorted({s for f in under.values() for s in f.signals} - set(outputs))
        if lacking:
            raise InputError(f"batch: criteria need the outputs {', '.join(lacking)}; the system has none.")
        if span < longest_window(criteria) - SAME_LENGTH:
            raise InputError(f"batch: criteria: {too_short(span, longest_window(criteria))}")
        unused = frozenset(n for n in under if n.removeprefix(UNDER_CRITERIA) not in WITH_GRADIENT)
        return cls(criteria, wanted, {**wanted, **under}, unused)

    @cached_property
    def _under(self) -> dict[str, str]:
        """Functionals under the criteria, by the names that the criteria have for them."""
        return {n.removeprefix(UNDER_CRITERIA): n for n in self.everything if n.startswith(UNDER_CRITERIA)}

    def answers(
        self, found: Mapping[str, Outcome], sequence: tuple[str, ...]
    ) -> tuple[Margins | None, dict[str, Outcome]]:
        """Margins, if asked for, and functionals of one completed case from its outcomes.

        Raises
        ------
        SimulationError
            the case has no margins, since it imports nothing before the fault.
        """
        answers = {name: found[name] for name in self.functionals}
        if self.criteria is None:
            return None, answers
        under = {short: found[name] for short, name in self._under.items()}
        try:
            return margins_of(self.criteria, under, sequence), answers
        except InputError as error:
            raise SimulationError(str(error)) from None
