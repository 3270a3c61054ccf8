"""The figures of a study, drawn from its folder alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from dcvrt.studies.findings import Findings
from dcvrt.studies.style import save, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_all(findings: Findings) -> list[Path]:
    """Draw every figure of a finished study as SVG and PNG into its folder `figures`.

    Parameters
    ----------
    findings : of the study's folder.

    Returns
    -------
    list of Path
        What was written. Figures of earlier runs under other names are removed.
    """
    into = findings.folder / "figures"
    written: list[Path] = []
    with styled():
        for name, figure in _figures(findings):
            written += save(figure, into, name)
    for path in into.glob("*.*"):
        if path.suffix in (".svg", ".png") and path not in written:
            path.unlink()
    return written


def _figures(findings: Findings) -> Iterator[tuple[str, Figure]]:
    from dcvrt.studies.figures import (
        capacity,
        faults,
        framework,
        internal_response,
        network_map,
        sensitivity,
        supervisor,
        system_limit,
        validation,
        worst,
    )

    yield "framework", framework.draw()
    yield "capacity", capacity.draw_totals(findings)
    yield "allocation", capacity.draw_allocation(findings)
    yield "validation", validation.draw(findings)
    yield "retained_voltage", faults.draw(findings)
    if findings.map_problem is None:
        yield (
            "network_map",
            network_map.draw(
                findings.network,
                findings.sites,
                findings.wind_buses,
                [fault.bus for fault in findings.faults],
                findings.no_vrt_by_site,
            ),
        )
    for mode in findings.modes:
        case = findings.worst_case(mode)
        if case is not None:
            yield f"worst_case_{mode}", worst.draw(findings, case)
    for mode in findings.modes:
        run, _ = internal_response.on_test_waveform(findings, mode)
        if run is not None:
            yield f"internal_response_{mode}", internal_response.draw(findings, mode, run)
    tradeoff = system_limit.draw(findings)
    if tradeoff is not None:
        yield "system_limit", tradeoff
    tornado = sensitivity.draw(findings)
    if tornado is not None:
        yield "sensitivity", tornado
    yield "supervisor", supervisor.draw(findings.facility(findings.modes[0]))
