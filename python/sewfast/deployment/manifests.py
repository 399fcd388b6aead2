"""What build systems ask of a folder of C: CMake, PlatformIO, Zephyr, and a page to read."""

from __future__ import annotations

import json

from .. import __version__
from ..control import Controller
from ..models import Model


def files(name: str, what: Model | Controller) -> dict[str, str]:
    """Texts by file name."""
    return {
        "CMakeLists.txt": _CMAKE.replace("@", name),
        "library.json": _platformio(name),
        "zephyr/module.yml": f"name: {name}\nbuild:\n  cmake: zephyr\n",
        "zephyr/CMakeLists.txt": _ZEPHYR.replace("@", name),
        "README.md": _readme(name, what),
    }


_CMAKE = """cmake_minimum_required(VERSION 3.10)
project(@ C)

# the bits of sewfast's own step: no fused multiply-add
add_library(@ STATIC @.c)
target_include_directories(@ PUBLIC ${CMAKE_CURRENT_SOURCE_DIR})
set_target_properties(@ PROPERTIES C_STANDARD 99)
target_compile_options(@ PRIVATE -ffp-contract=off)

enable_testing()
add_executable(@_test EXCLUDE_FROM_ALL @_test.c)
target_link_libraries(@_test @)
add_test(NAME @ COMMAND @_test)
"""

_ZEPHYR = """zephyr_library()
zephyr_library_sources(../@.c)
zephyr_library_compile_options(-ffp-contract=off)
zephyr_include_directories(..)
"""


def _platformio(name: str) -> str:
    library = {
        "name": name,
        "version": __version__,
        "description": "Written by sewfast",
        "license": "0BSD",
        "frameworks": "*",
        "platforms": "*",
        "build": {
            "srcFilter": [f"+<{name}.c>"],
            "srcDir": ".",
            "includeDir": ".",
            "flags": ["-ffp-contract=off"],
        },
    }
    return json.dumps(library, indent=2) + "\n"


def _readme(name: str, what: Model | Controller) -> str:
    if isinstance(what, Controller):
        use = (
            f"static {name}_pid pid;\n\n{name}_init(&pid);           /* once */\n"
            f"u = {name}_step(&pid, r, y); /* every {what.Ts:g} s */"
        )
    else:
        use = (
            f"static {name}_model plant;\n\n{name}_init(&plant);          /* once */\n"
            f"y = {name}_step(&plant, &u); /* every {what.Ts:g} s */"
        )
    return f"""# {name}

```c
#include "{name}.h"

{use}
```

- `{name}.c` and `{name}.h` are all that the firmware needs.
- `{name}_test.c` compares the results on your processor with those of sewfast, bit by bit:
  `cc -std=c99 -ffp-contract=off {name}.c {name}_test.c && ./a.out`
- CMake: `add_subdirectory`, then link `{name}`. PlatformIO: put this folder into `lib/`. Zephyr:
  name it in `ZEPHYR_EXTRA_MODULES`.

You may use the code under MIT, Apache-2.0 or 0BSD, as you like.
"""
