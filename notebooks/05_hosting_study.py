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
# # A hosting study, small enough to watch
#
# How much data-centre load can the IEEE 118-bus system host at two buses, if both sites must ride through two
# faults? The full study has four sites, seven faults, three periods and twelve ratings; this one takes about a
# minute and goes through every step of it.

# %%
import tempfile
from pathlib import Path

import pandas as pd

from dcvrt.studies import Study

folder = Path(tempfile.mkdtemp())
study_file = folder / "small.toml"
study_file.write_text(
    """
[study]
name = "Two sites, two faults"

[grid]
case = "ieee118"
sites = [21, 75]
t_end_s = 1.0

[hosting]
hours = [8400, 8568]        # a week around the winter peak

[[fault]]
bus = 25
[[fault]]
bus = 77

[[period]]
name = "peak"
hour = "peak"

[facility]
modes = ["gfl", "gfm"]
beta = [1.0, 1.2, 1.4]

[sampling]
n = 6
""",
    encoding="utf-8",
)
study = Study.load(study_file)
print(study.file.study.name, "- sites", study.file.grid.sites)

# %% [markdown]
# ## Run it
#
# One folder comes out: a store with every simulation, tables, figures and a report. Running the same study into the
# same folder again resumes; nothing is simulated twice.

# %%
result = study.run(out=folder / "results", workers=1)
assert result.complete, result.lost
for path in sorted((folder / "results").iterdir()):
    print(path.name)

# %% [markdown]
# ## What it says
#
# One row a plan. `replay` is the verdict of the complete nonlinear simulation at the plan itself: a plan that fails it
# is no result, however good its fitted margins are.

# %%
table = result.table()
table[["method", "mode", "beta", "total_mw", "bus_21_mw", "bus_75_mw", "replay", "ac", "closed_sites"]]

# %%
counts = result.summary["simulations"]
print(f"{counts['grid']} fault simulations, {counts['facility']} facility runs, {counts['failed']} failed")
no_vrt = result.summary["no_vrt"]["total_mw"]
for row in result.summary["rows"]:
    assert row["total_mw"] <= no_vrt + 1e-6, "ride-through can only take capacity away"

# %% [markdown]
# Capacity against the rating, as the report draws it:

# %%
from dcvrt.studies.figures import capacity
from dcvrt.studies.findings import Findings
from dcvrt.studies.style import styled

findings = Findings(result.folder)
with styled():
    figure = capacity.draw_totals(findings)
figure

# %% [markdown]
# ## How good are the fits?
#
# The margins are fitted on some samples and judged on others. A false pass is a point that the fit passes and the
# simulation fails.

# %%
pd.DataFrame(result.summary["surrogate"])

# %% [markdown]
# ## Why a site is closed
#
# The retained voltage of a fault hardly depends on what is hosted, so a site opens at the rating that its worst fault
# asks for. The static law says: the loss stays within the share when V >= (1 - share) / beta.

# %%
from dcvrt.studies.figures import faults

with styled():
    figure = faults.draw(findings)
figure

# %%
for row in result.summary["rows"]:
    shut = [entry for entry in row["binding"] if entry["kind"] == "closed"]
    for entry in shut:
        print(f"{row['mode']}, beta {row['beta']:g}, {row['method']}: bus {entry['bus']} closed: {entry['label']}")

# %% [markdown]
# The report is one file that needs no network: `results/report.html`.
