"""Where dcvrt keeps what can be made again: compiled models, generated code of the fault simulator."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def cache_folder() -> Path:
    """Return `$DCVRT_CACHE_DIR`, or the folder `dcvrt` among the user's caches.

    Read at every call, so that a program may set the variable after the import.
    """
    if chosen := os.environ.get("DCVRT_CACHE_DIR"):
        return Path(chosen)
    if sys.platform == "win32":
        local = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
        return Path(local) / "dcvrt" / "cache"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "dcvrt"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dcvrt"
