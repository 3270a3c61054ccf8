"""What is installed on this machine, for `dcvrt doctor`."""

from __future__ import annotations

import os
import platform

from dcvrt.studies.study import versions


def examine() -> tuple[str, bool]:
    """Versions, compiler and caches as text; True when nothing that a study needs is missing."""
    from dcvrt.cache import cache_folder
    from dcvrt.integrators import find_compiler

    found = versions()
    healthy = "not installed" not in found.values()
    lines = [f"{name:12} {value}" for name, value in found.items()]
    lines.append(f"{'platform':12} {platform.platform()}, {os.cpu_count()} processors")
    if not healthy:
        lines.append("  missing packages: pip install dcvrt brings all of them")
    compiler = find_compiler()
    if compiler is None:
        lines.append(
            f"{'compiler':12} none: facility models are interpreted, several times slower, with the same "
            f"numbers"
        )
        lines.append("  way out: install gcc or clang, or pip install 'dcvrt[compiler]'")
    else:
        lines.append(f"{'compiler':12} {compiler}")
    lines.append(f"{'cache':12} {cache_folder()}")
    if found["andes"] != "not installed":
        from dcvrt.grid import andes

        state = (
            "ready" if andes.prepared() else "generated at the first fault simulation, up to half a minute"
        )
        lines.append(f"{'andes code':12} {state} ({andes.code_folder()})")
    return "\n".join(lines), healthy
