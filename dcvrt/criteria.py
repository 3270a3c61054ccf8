"""stub while building"""
from __future__ import annotations
from dataclasses import dataclass
@dataclass(frozen=True)
class Criteria: pass
class Margins: pass
def margins(run, c): return None
