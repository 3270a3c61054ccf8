"""The shared object of one system: its C text and the driver, compiled once and kept."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from dcvrt.integrators.compiler import Compiler, build, native_flags
from dcvrt.integrators.kernel.model import ModelText

FLAGS = (
    "-std=gnu11", "-O3", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast", "-fPIC", "-shared",
)  # fmt: skip
QUIET = ("-Wno-psabi", "-w")
WIDEST = 8
"""Most thetas in one column of the scalar loop."""

UNITS = {
    "scalar.c": """#define LANES 1
#define RUN run_one_lane
#include "model.h"
#include "lanes.h"
#include "scalar_equations.h"
#include "course.c"
#include "loop.c"
#include "again.c"
#include "single.c"
#include "corners.c"
#include "rest.c"
""",
    "functionals.c": "",
    "many.c": """#include "width.h"
#define RUN run_many_lanes
#include "model.h"
#include "lanes.h"
#include "lanes_equations.h"
#include "loop.c"
#include "outputs.c"
int lanes_at_once(void) { return LANES; }
""",
}


def columns(thetas: int) -> int:
    """Thetas that one column holds on one lane: a power of two."""
    return min(WIDEST, 1 << max(thetas - 1, 0).bit_length())


def sources(model: ModelText, method: str) -> dict[str, str]:
    """All C files of one object by name."""
    folder = resources.files("dcvrt.integrators.kernel") / "driver"
    files = {f.name: f.read_text(encoding="utf-8") for f in folder.iterdir() if f.name.endswith((".c", ".h"))}
    sizes = f'#define COLUMNS {columns(model.equations.nw)}\n#define METHOD "{method}.h"\n'
    return {
        **UNITS,
        **files,
        "model.h": sizes + model.header(),
        "scalar_equations.h": model.scalar(),
        "lanes_equations.h": model.lanes(),
        "elimination_text.h": model.elimination() if model.implicit else "",
    }


def build_object(model: ModelText, method: str, compiler: Compiler) -> Path:
    """Path of the compiled object, from the cache or made now.

    Raises
    ------
    InputError
        the compiler fails; its own message is kept.
    """
    flags = (*FLAGS, *native_flags(compiler), *QUIET)
    return build(sources(model, method), compiler, flags, tuple(UNITS))
