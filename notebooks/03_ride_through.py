# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Riding through a fault: one facility, one waveform
#
# A data centre hangs on a double-conversion UPS. When the grid voltage sags, the converter cannot import what the
# load takes. The DC link empties, the battery steps in, and a supervisor decides when to let go of the grid and
# when to come back. This notebook runs that chain on prescribed voltages and reads off the two margins that a
# planner needs: how low the protected voltage gets, and how much import the grid loses.
#
# All parameters used here are illustrative unless their source says otherwise: `print(dae.parameters)`.

# %%
import matplotlib.pyplot as plt
import numpy as np

from dcvrt import Criteria, Simulator, Waveform, facility, margins

dae = facility.gfl().compile()
print(dae.name, "-", len(dae.states), "states,", len(dae.parameters), "parameters")
print("modes:", ", ".join(dae.automaton_behind("mode").modes))
for row in dae.automaton_behind("mode").rows:
    print("  ", row.text)

# %% [markdown]
# ## A sag
#
# The voltage falls to 0.66 pu for 100 ms. The converter is rated 1.10 times the capacity (beta), so it can import at
# most beta times the voltage, 0.73 per unit of capacity. What the load takes beyond that comes from the battery.

# %%
sim = Simulator(dae, wrt=("beta", "H"), save_at=1e-3)
sag = Waveform.sag(retained=0.66, start=0.10, length=0.10, until=1.5)
run = sim(sag, H=1.0, beta=1.10)
print(run.status)
for event in run.events:
    print(f"{event.time:7.4f} s  {event.source} -> {event.target}")

# %%
figure, (volts, powers) = plt.subplots(2, 1, figsize=(7, 5), sharex=True, layout="constrained")
volts.plot(run.t, np.abs(sag.at(run.t)), "k--", label="POI voltage")
volts.plot(run.t, run["v_it"], label="protected IT voltage")
volts.set_ylabel("voltage (pu)")
volts.legend()
powers.plot(run.t, run["p_g"], "k", label="import at the POI")
powers.plot(run.t, run["p_b"], label="battery")
powers.plot(run.t, run["p_out"], ":", label="facility load")
powers.set(xlabel="time (s)", ylabel="power (pu of H)", xlim=(0.0, 0.8))
powers.legend()
plt.show()

# %% [markdown]
# ## Margins
#
# The voltage margin is the level below which the protected voltage stayed for a whole window, less the level that
# is required. The loss margin is the allowed share of lost import less the largest loss that lasts a whole window.
# Both come with their gradients. `sequence` names the modes passed through: gradients hold while it stays the same.

# %%
criteria = Criteria(v_it_min=0.90, window=0.020, loss_share=0.25)
m = margins(run, criteria)
print(f"voltage margin {m.voltage.value:+.4f} pu, d/dbeta {m.voltage.grad['beta']:+.4f}")
print(f"loss margin    {m.loss.value:+.4f} of the import, d/dbeta {m.loss.grad['beta']:+.4f}")
print("sequence:", m.sequence)
assert run.status == "completed"

# %% [markdown]
# The gradient can be checked by running twice at neighbouring ratings.

# %%
step = 1e-3
up, down = (margins(sim(sag, H=1.0, beta=1.10 + s), criteria).loss.value for s in (step, -step))
difference = (up - down) / (2 * step)
print(f"difference {difference:.5f}, gradient {m.loss.grad['beta']:.5f}")
assert abs(difference - m.loss.grad["beta"]) < 0.02 * abs(difference)

# %% [markdown]
# ## How large must the converter be?
#
# By the static law of a current-limited converter the import falls to beta V. With 25 % of the import p before the
# fault allowed to be lost, beta must be at least 0.75 p / V. Here is what the dynamic model says, in both modes.

# %%
betas = np.linspace(1.0, 1.3, 7)
losses = {}
for name in ("gfl", "gfm"):
    simulator = Simulator(facility.get(name).compile())
    result = simulator.batch([sag] * len(betas), {"H": 1.0, "beta": betas.tolist()}, criteria=criteria)
    losses[name] = result.table()
    assert (losses[name]["status"] == "completed").all()
before = float(run["p_g"][0])
print(f"import before the fault {before:.3f}, static limit beta = {0.75 * before / 0.66:.3f}")
losses["gfl"][["beta", "voltage", "loss", "loss_share", "status"]]

# %%
figure, axes = plt.subplots(figsize=(6, 3.2), layout="constrained")
for name, marker in (("gfl", "o"), ("gfm", "s")):
    axes.plot(betas, losses[name]["loss"], marker=marker, label=name.upper())
axes.axhline(0.0, color="0.5", linewidth=0.8)
axes.axvline(0.75 * before / 0.66, color="0.5", linestyle=":", label="static limit")
axes.set(xlabel="converter rating over capacity, beta", ylabel="loss margin")
axes.legend()
plt.show()

# %% [markdown]
# ## The test waveform
#
# Ramp, shallow fault, deep fault and high voltage in one run. The waveform is *ERCOT-style*: our own composition on
# published boundaries, not ERCOT's official test waveform. Shades show the supervisor's modes.

# %%
from dcvrt.studies.figures import ride
from dcvrt.studies.style import styled

profile = Waveform.ercot_style()
run = Simulator(dae, save_at=2e-3)(profile, beta=1.15)
with styled():
    figure = ride.draw(
        ride.signals_of(run, profile.at(run.t)),
        dae.automaton_behind("mode").modes,
        "GFL, beta = 1.15, ERCOT-style test waveform (not the official one)",
        criteria.v_it_min,
    )
figure

# %%
visited = {dae.automaton_behind("mode").modes[int(round(k))] for k in run["mode"]}
print("modes visited:", ", ".join(sorted(visited)))
assert "BATTERY" in visited, "the deep fault must take the facility off the grid"
