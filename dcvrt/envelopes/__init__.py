"""Ride-through envelopes of grid codes: as waveforms to run on, and as a check of the response.

What is loaded here is light; waveforms and checks are loaded when an envelope is asked for them.
"""

from __future__ import annotations

from dcvrt.envelopes.table import MARKS, Envelope, get, names

__all__ = ["MARKS", "Envelope", "get", "names"]
