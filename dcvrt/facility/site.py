"""What every facility has: parameters and inputs of the whole, and what its loads ask for."""

from __future__ import annotations

from collections.abc import Mapping

from dcvrt.models import AuxiliaryLoad, Cooling, Diagram, ItLoad, Phasor
from dcvrt.models.block import Port

CONVERTER_RATING = (1.15, "converter rating over H", "illustrative")


def site(name: str, doc: str, cooling: Cooling, rating: tuple[float, str, str] = CONVERTER_RATING) -> Diagram:
    """Diagram with the shared parameters, `v_poi`, `g_it`, and the demands `it`, `cooling` and `aux`.

    Parameters
    ----------
    name, doc : of the diagram.
    cooling : the block that knows what the cooling asks for.
    rating : value, meaning and source of the parameter beta.
    """
    f = Diagram(name, doc)
    H = f.parameter("H", 1.0, "pu(S)", (1e-6, 1e3), "hosted capacity", "decision of the planner")
    value, meaning, source = rating
    f.parameter("beta", value, "1", (0.8, 2.0), meaning, source)
    d = f.parameter("d", 0.95, "1", (0.1, 1.2), "load factor: demand over H at g_it = 1", "illustrative")
    f.parameter("pf", 0.98, "1", (0.8, 1.0), "power factor of the import, lagging", "illustrative")
    pue = f.parameter("PUE", 1.3, "1", (1.0, 3.0), "facility over IT energy", "illustrative; average 1.54")
    k_cool = f.parameter("cooling_share", 0.74, "1", (0.0, 1.0), "cooling in non-IT demand", "illustrative")

    f.input("v_poi", "pu(V)", Phasor, rest=1.0, doc="POI voltage, positive sequence, network frame")
    g_it = f.input("g_it", "1", rest=1.0, doc="normalised IT load")

    it = f.add("it", ItLoad())
    f.add("cooling", cooling)
    aux = f.add("aux", AuxiliaryLoad())
    f.bind(it, H=H, d=d, share=1 / pue)
    f.bind(cooling, H=H, d=d, share=(1 - 1 / pue) * k_cool)
    f.bind(aux, H=H, d=d, share=(1 - 1 / pue) * (1 - k_cool))
    f.connect(g_it, it.g_it, cooling.g_it)
    return f


def give_names(f: Diagram, usual: Mapping[str, str], others: Mapping[str, Port]) -> None:
    """Name the outputs that every variant has: `usual` places, but for those that come from elsewhere."""
    for output, path in usual.items():
        f.output(output, others[output] if output in others else f.port(path))
