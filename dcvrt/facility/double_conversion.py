"""Facilities behind a double-conversion UPS: rectifier, DC link with battery, inverter."""

from __future__ import annotations

from dcvrt.facility.site import give_names, site
from dcvrt.models import (
    ActivePriorityLimiter,
    Bess,
    Block,
    Cooling,
    CurrentLag,
    CurrentReference,
    DcEnergyLoop,
    DcLink,
    Diagram,
    DriveCooling,
    Droop,
    FacilityLoad,
    Pll,
    Poi,
    ProtectedBus,
    ReactivePriorityLimiter,
    ReactiveSupport,
    SagCounter,
    ServerSupply,
    SharedPoi,
    SplitFacilityLoad,
    Supervisor,
    SupervisorWithLockout,
    UpsAndDriveLedger,
    UpsLedger,
    VoltageFilter,
    Vsm,
)
from dcvrt.models.block import Port

# ---- grid-following --------------------------------------------------------------------------------------


def gfl() -> Diagram:
    """Double-conversion UPS with a grid-following front end: PLL, current reference, current limit.

    What it is: the usual large on-line UPS. An active rectifier draws a current in phase with the voltage
    that it measures; the inverter feeds servers, cooling and auxiliaries from the DC link. What for: the
    reference of every study, the first of the paper's two control modes.

    In a sag the current limit beta H caps the import at beta V, the battery covers the rest at once (MIXED);
    a deep or long sag ends in BATTERY with an import of zero, a healthy grid in RETURN, where the import is
    walked in over sup.T_ramp. It gives no reactive support.

    Left out: static bypass, unbalance, harmonics, single modules of a large UPS. Equations: the paper's, see
    the blocks; parameters are illustrative where their source says so.

    >>> gfl().compile().u_names
    ('v_poi.re', 'v_poi.im', 'g_it')
    """
    f = _double_conversion("gfl", "double-conversion UPS with a grid-following front end", Supervisor())
    _grid_following(f, f.port("dc_loop.q_c"))
    return f


def gfl_support() -> Diagram:
    """Grid-following UPS that supports the voltage: reactive current in sags and swells, and first in line.

    What it is: `gfl` under a grid code that asks converters for reactive current in proportion to the voltage
    error (K = 2 beyond a deadband of 0.1 pu, both illustrative). The current limiter gives reactive current
    priority. What for: to see what support costs in active power.

    In a sag below the deadband it injects reactive power; where the rating is used up, active import yields
    and the battery covers it. At rest and within the deadband it is `gfl`. With ``support.K = 0`` and the
    limiter of `gfl` it is `gfl` in every sag.

    Left out: support in the negative sequence, and any effect of the support on the grid voltage unless the
    waveform comes from a coupled simulation. The DC-energy loop does not know of the priority.
    """
    f = _double_conversion(
        "gfl-support", "grid-following double-conversion UPS with reactive support", Supervisor()
    )
    support = f.add("support", ReactiveSupport())
    f.bind(support, H=f.shared["H"].symbol)
    f.connect(f.port("dc_loop.q_c"), support.q_c)
    f.connect(f.port("meter.v_f"), support.v_f)
    _grid_following(f, support.q)
    f.replace("lim", ReactivePriorityLimiter())
    return f


def gfl_sag_counter() -> Diagram:
    """Grid-following UPS that counts sags and, after three in a minute, locks itself on its battery.

    What it is: `gfl` with a logic that spares battery and switchgear the cycling by a grid that dips again
    and again. What for: a fault with reclosings, or a storm, which
    takes whole sites off the grid although each single sag would be ridden through.

    Every sag below counter.V_count is counted once. With counter.N of them within counter.T_window it goes
    from any mode to BATTERY at once, and stays there until the voltage has been healthy for counter.T_reset
    (a reset by hand: a longer time than the run). Before that it is `gfl`.

    The count and the window (3 in 1 minute) are told of the disturbance of July 2024 and are not verified;
    ERCOT's NOGRR282 prohibits the counting of sags. Left out: the generators that start while the battery
    empties.
    """
    sup = SupervisorWithLockout()
    f = _double_conversion("gfl-sag-counter", "grid-following double-conversion UPS that counts sags", sup)
    _grid_following(f, f.port("dc_loop.q_c"))
    counter = f.add("counter", SagCounter())
    f.set("counter.N", 3.0, "told of the disturbance of July 2024, not verified")
    f.connect(f.port("meter.v_f"), counter.v_f)
    f.connect(counter.lock, sup.lock)
    f.output("mode_counter", counter.mode)
    return f


def gfl_vfd_cooling() -> Diagram:
    """Grid-following UPS for the servers, cooling by variable-speed drives straight on the grid.

    What it is: a site whose chillers, pumps and fans are too big for the UPS; they hang on the POI behind
    feeders of their own, each behind a drive whose DC bus is small. What for: whether cooling trips in
    sags that the UPS rides through, and how much load the grid then loses for minutes.

    In a sag the rectifiers of the drives stop to conduct until their DC bus has fallen with the grid; below
    w_trip the drives trip, wait for T_restart of healthy voltage and ramp up over T_ramp. Servers and
    auxiliaries behave as in `gfl`. At rest the import is that of `gfl`.

    `p_g`, `q_g` and `i_g` are those of the site; `i_max` is the largest current of UPS and drives together.
    `p_ups` and `i_ups` are the UPS alone. `p_out` is what all loads get, `p_cool` what the motors get,
    `p_load` what all ask for. beta is the rating of the UPS over all of H, of which it feeds the part without
    cooling: 1.15 here is more headroom than 1.15 in `gfl`.

    Left out: heating up of the halls while cooling stands, drives that trip one by one, motors without
    drives, the dependence of one facility's voltage on its own current.
    """
    drive, load, ledger = DriveCooling(), SplitFacilityLoad(), UpsAndDriveLedger()
    doc = "grid-following UPS for the servers; cooling by drives on the POI, unprotected"
    f = _ups("gfl-vfd-cooling", doc, drive, load, Supervisor(), ledger)
    _grid_following(f, f.port("dc_loop.q_c"))
    site = f.add("site", SharedPoi())

    f.bind(drive, pf=f.shared["pf"].symbol)
    f.connect(f.port("v_poi"), drive.v, site.v)
    f.connect(drive.p, load.cooling)
    f.connect(drive.demand, load.cooling_demand)
    f.connect(drive.i, site.direct)
    f.connect(f.port("lag.i"), site.ups)
    f.connect(drive.i_max, site.direct_max)
    f.connect(f.port("lim.i_max"), site.ups_max)
    f.connect(drive.energy, ledger.drive_energy)
    f.connect(drive.loss, ledger.drive_loss)

    _name_outputs(
        f, p_g=site.p, q_g=site.q, i_g=site.i_mag, i=site.drawn, i_max=site.i_max, p_out=load.served
    )
    f.output("p_ups", f.port("poi.p"))
    f.output("i_ups", f.port("poi.i_mag"))
    f.output("w_drive", drive.w)
    f.output("mode_cooling", drive.mode)
    return f


def _grid_following(f: Diagram, q_c: Port) -> None:
    """PLL and current reference as the grid-facing control."""
    pll = f.add("pll", Pll())
    ref = f.add("ref", CurrentReference())
    f.connect(f.port("v_poi"), pll.v, ref.v)
    f.connect(pll.delta, ref.delta, f.port("lag.delta"))
    f.connect(pll.error, f.port("sup.error"))
    f.connect(f.port("dc_loop.p_c"), ref.p_c)
    f.connect(q_c, ref.q_c)
    f.connect(ref.i, f.port("lim.ask"))
    f.connect(ref.v_dq, f.port("lim.v"))


# ---- grid-forming ----------------------------------------------------------------------------------------


def gfm() -> Diagram:
    """Double-conversion UPS with a grid-forming front end: a virtual synchronous machine.

    What it is: the same UPS, whose rectifier holds a voltage behind a virtual impedance and lets it swing
    like a machine. What for: the second of the paper's two control modes.

    At rest it imports what `gfl` imports. At the first moment of a sag or a phase jump its current answers
    without waiting for a measurement, and the angle then finds the commanded power within a swing. Limit,
    battery, supervisor and loads are those of `gfl`; two gains of the DC loop are lower, since the pair with
    the swing would be unstable.

    Left out: what `gfl` leaves out, and islanded operation of the grid side.
    """
    f = _double_conversion("gfm", "double-conversion UPS with a grid-forming front end", Supervisor())
    _grid_forming(f, "vsm", Vsm())
    return f


def gfm_droop() -> Diagram:
    """Double-conversion UPS with a grid-forming front end: droop with measured powers, frozen in a dip.

    What it is: the control that most grid-forming converters have, with the droops, measurement lag and
    freeze of ANDES REGF1. What for: how much of `gfm` hangs on its virtual inertia.

    At rest and for small disturbances it is `gfm` with H_v = T_f/(2 m_p) and D = 1/m_p. Below 0.8 pu of
    measured voltage its angle and measurements stand still until 0.85 pu, so that it comes back with the
    angle that it had; `gfm` keeps swinging.

    Left out: what `gfm` leaves out, and the inner voltage loop of REGF1.
    """
    f = _double_conversion(
        "gfm-droop", "double-conversion UPS with a grid-forming front end: droop", Supervisor()
    )
    droop = Droop()
    _grid_forming(f, "droop", droop)
    f.connect(f.port("meter.v_f"), droop.v_f)
    return f


def _grid_forming(f: Diagram, name: str, source: Vsm | Droop) -> None:
    """An internal voltage as the grid-facing control."""
    f.add(name, source)
    f.bind(source, H=f.shared["H"].symbol)
    f.connect(f.port("v_poi"), source.v)
    f.connect(source.delta, f.port("lag.delta"))
    f.connect(source.error, f.port("sup.error"))
    f.connect(f.port("sup.resync"), source.resync)
    f.connect(f.port("sup.trim"), source.trim)
    f.connect(f.port("dc_loop.p_c"), source.p_c)
    f.connect(f.port("dc_loop.q_c"), source.q_c)
    f.connect(f.port("poi.p"), source.p_g)
    f.connect(f.port("poi.q"), source.q_g)
    f.connect(f.port("lim.shortfall"), source.shortfall)
    f.connect(source.i, f.port("lim.ask"))
    f.connect(source.v_dq, f.port("lim.v"))

    slower = (
        "illustrative: at the grid-following gain this loop is faster than the swing of the virtual machine "
        "that it commands (about 110 rad/s), and the pair is unstable"
    )
    f.set("dc_loop.K_p", 1.0, slower)
    f.set("dc_loop.K_i", 5.0, slower)


# ---- what they share -------------------------------------------------------------------------------------


def _double_conversion(name: str, doc: str, supervisor: Supervisor) -> Diagram:
    """Everything but the grid-facing control, all loads on the protected bus."""
    f = _ups(name, doc, Cooling(), FacilityLoad(), supervisor, UpsLedger())
    f.connect(f.port("cooling.p"), f.port("load.cooling"))
    _name_outputs(f)
    return f


def _ups(
    name: str, doc: str, cooling: Cooling, load: Block, supervisor: Supervisor, ledger: UpsLedger
) -> Diagram:
    """Loads, DC link, battery, protected bus, limit, supervisor; where the cooling hangs is left open."""
    f = site(name, doc, cooling)
    H, beta, pf = (f.shared[k].symbol for k in ("H", "beta", "pf"))
    v = f.port("v_poi")

    psu = f.add("psu", ServerSupply())
    f.add("load", load)
    meter = f.add("meter", VoltageFilter())
    sup = f.add("sup", supervisor)
    dc_loop = f.add("dc_loop", DcEnergyLoop())
    lim = f.add("lim", ActivePriorityLimiter())
    lag = f.add("lag", CurrentLag())
    poi = f.add("poi", Poi())
    dc = f.add("dc", DcLink())
    bess = f.add("bess", Bess())
    bus = f.add("bus", ProtectedBus())
    f.add("ledger", ledger)

    f.bind(dc_loop, H=H, beta=beta, pf=pf)
    f.bind(lim, H=H, beta=beta)
    f.bind(bus, H=H, beta=beta, pf=pf)
    f.bind(dc, H=H)
    f.bind(bess, H=H)

    f.connect(f.port("it.p"), psu.demand, load.it_demand)
    f.connect(psu.p, load.it)
    f.connect(f.port("aux.p"), load.auxiliary)
    f.connect(load.p, dc.p_out, bus.p_out)

    f.connect(v, meter.v, dc_loop.v, poi.v)
    f.connect(meter.v_f, sup.v_f, bus.v_f)
    f.connect(sup.share, lim.share, dc_loop.share)
    f.connect(sup.trim, dc_loop.steady)
    f.connect(sup.assist, bess.assist)
    f.connect(sup.charge, bess.charge)

    f.connect(lim.i, lag.ask)
    f.connect(lag.i, poi.i)
    f.connect(poi.p, dc.p_g, bess.p_g)

    f.connect(dc.w, dc_loop.w, lim.w, bess.w, bus.w, sup.w)
    f.connect(dc.drain, dc_loop.p_ref, bess.drain)
    f.connect(bess.p, dc.p_b)
    f.connect(bus.v, psu.v_it)

    f.connect(dc.energy, ledger.dc_energy)
    f.connect(dc.loss, ledger.dc_loss)
    f.connect(bess.energy, ledger.battery_energy)
    f.connect(bess.loss, ledger.battery_loss)
    return f


def _name_outputs(f: Diagram, **others: Port) -> None:
    """The outputs that every variant has, some of them from other places than usual."""
    usual = {
        "v_it": "bus.v", "p_g": "poi.p", "q_g": "poi.q", "i_g": "poi.i_mag", "i_max": "lim.i_max",
        "p_b": "bess.p", "soc": "bess.soc", "w_dc": "dc.w",
        "p_load": "load.demand", "p_out": "load.p", "p_it": "psu.p", "p_cool": "cooling.p",
        "mode": "sup.mode", "stored": "ledger.stored", "p_loss": "ledger.loss", "i": "poi.drawn",
    }  # fmt: skip
    give_names(f, usual, others)
