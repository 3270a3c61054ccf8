"""Facilities behind a double-conversion UPS: rectifier, DC link with battery, inverter."""

from __future__ import annotations

from dcvrt.models import (
    ActivePriorityLimiter,
    AuxiliaryLoad,
    Bess,
    Cooling,
    CurrentLag,
    CurrentReference,
    DcEnergyLoop,
    DcLink,
    Diagram,
    FacilityLoad,
    ItLoad,
    Phasor,
    Pll,
    Poi,
    ProtectedBus,
    ServerSupply,
    Supervisor,
    VoltageFilter,
    Vsm,
)


def gfl() -> Diagram:
    """Double-conversion UPS with a grid-following front end: PLL, current reference, current limit.

    >>> gfl().compile().u_names
    ('v_poi.re', 'v_poi.im', 'g_it')
    """
    f = _double_conversion("gfl", "double-conversion UPS with a grid-following front end")
    v, dc_loop, lim, lag, sup = f.port("v_poi"), *(f.blocks[k] for k in ("dc_loop", "lim", "lag", "sup"))

    pll = f.add("pll", Pll())
    ref = f.add("ref", CurrentReference())
    f.connect(v, pll.v, ref.v)
    f.connect(pll.delta, ref.delta, lag.delta)
    f.connect(pll.error, sup.error)
    f.connect(dc_loop.p_c, ref.p_c)
    f.connect(dc_loop.q_c, ref.q_c)
    f.connect(ref.i, lim.ask)
    f.connect(ref.v_dq, lim.v)
    return f


def gfm() -> Diagram:
    """Double-conversion UPS with a grid-forming front end: a virtual synchronous machine."""
    f = _double_conversion("gfm", "double-conversion UPS with a grid-forming front end")
    v, dc_loop, lim, lag, sup = f.port("v_poi"), *(f.blocks[k] for k in ("dc_loop", "lim", "lag", "sup"))
    poi = f.blocks["poi"]

    vsm = f.add("vsm", Vsm())
    f.bind(vsm, H=f.shared["H"].symbol)
    f.connect(v, vsm.v)
    f.connect(vsm.delta, lag.delta)
    f.connect(vsm.error, sup.error)
    f.connect(sup.resync, vsm.resync)
    f.connect(sup.trim, vsm.trim)
    f.connect(dc_loop.p_c, vsm.p_c)
    f.connect(dc_loop.q_c, vsm.q_c)
    f.connect(poi.p, vsm.p_g)
    f.connect(poi.q, vsm.q_g)
    f.connect(lim.shortfall, vsm.shortfall)
    f.connect(vsm.i, lim.ask)
    f.connect(vsm.v_dq, lim.v)

    slower = (
        "illustrative: at the grid-following gain this loop is faster than the swing of the virtual machine "
        "that it commands (about 110 rad/s), and the pair is unstable"
    )
    f.set("dc_loop.K_p", 1.0, slower)
    f.set("dc_loop.K_i", 5.0, slower)
    return f


def _double_conversion(name: str, doc: str) -> Diagram:
    """Everything but the grid-facing control: loads, DC link, battery, protected bus, limit, supervisor."""
    f = Diagram(name, doc)
    H = f.parameter("H", 1.0, "pu(S)", (1e-6, 1e3), "hosted capacity", "decision of the planner")
    beta = f.parameter("beta", 1.15, "1", (0.8, 2.0), "converter rating over H", "illustrative")
    d = f.parameter("d", 0.95, "1", (0.1, 1.2), "load factor: demand over H at g_it = 1", "illustrative")
    pf = f.parameter("pf", 0.98, "1", (0.8, 1.0), "power factor of the import, lagging", "illustrative")
    pue = f.parameter("PUE", 1.3, "1", (1.0, 3.0), "facility over IT energy", "illustrative; average 1.54")
    k_cool = f.parameter("cooling_share", 0.74, "1", (0.0, 1.0), "cooling in non-IT demand", "illustrative")

    v = f.input("v_poi", "pu(V)", Phasor, rest=1.0, doc="POI voltage, positive sequence, network frame")
    g_it = f.input("g_it", "1", rest=1.0, doc="normalised IT load")

    it = f.add("it", ItLoad())
    cooling = f.add("cooling", Cooling())
    aux = f.add("aux", AuxiliaryLoad())
    psu = f.add("psu", ServerSupply())
    load = f.add("load", FacilityLoad())
    meter = f.add("meter", VoltageFilter())
    sup = f.add("sup", Supervisor())
    dc_loop = f.add("dc_loop", DcEnergyLoop())
    lim = f.add("lim", ActivePriorityLimiter())
    lag = f.add("lag", CurrentLag())
    poi = f.add("poi", Poi())
    dc = f.add("dc", DcLink())
    bess = f.add("bess", Bess())
    bus = f.add("bus", ProtectedBus())

    f.bind(it, H=H, d=d, share=1 / pue)
    f.bind(cooling, H=H, d=d, share=(1 - 1 / pue) * k_cool)
    f.bind(aux, H=H, d=d, share=(1 - 1 / pue) * (1 - k_cool))
    f.bind(dc_loop, H=H, beta=beta, pf=pf)
    f.bind(lim, H=H, beta=beta)
    f.bind(bus, H=H, beta=beta, pf=pf)
    f.bind(dc, H=H)
    f.bind(bess, H=H)

    f.connect(g_it, it.g_it, cooling.g_it)
    f.connect(it.p, psu.demand, load.it_demand)
    f.connect(psu.p, load.it)
    f.connect(cooling.p, load.cooling)
    f.connect(aux.p, load.auxiliary)
    f.connect(load.p, dc.p_out, bus.p_out)

    f.connect(v, meter.v, dc_loop.v, poi.v)
    f.connect(meter.v_f, sup.v_f, bus.v_f)
    f.connect(sup.share, lim.share, dc_loop.share)
    f.connect(sup.assist, bess.assist)
    f.connect(sup.charge, bess.charge)

    f.connect(lim.i, lag.ask)
    f.connect(lag.i, poi.i)
    f.connect(poi.p, dc.p_g, bess.p_g)

    f.connect(dc.w, dc_loop.w, lim.w, bess.w, bus.w, sup.w)
    f.connect(dc.drain, dc_loop.p_ref, bess.drain)
    f.connect(bess.p, dc.p_b)
    f.connect(bus.v, psu.v_it)

    for output, source in {
        "v_it": bus.v, "p_g": poi.p, "q_g": poi.q, "i_g": poi.i_mag, "i_max": lim.i_max,
        "p_b": bess.p, "soc": bess.soc, "w_dc": dc.w,
        "p_load": load.demand, "p_out": load.p, "p_it": psu.p, "p_cool": cooling.p, "mode": sup.mode,
    }.items():  # fmt: skip
        f.output(output, source)
    return f
