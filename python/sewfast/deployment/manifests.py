"""Files for the build systems of C code: CMake, PlatformIO, Zephyr, and a page of instructions."""

from __future__ import annotations

import json

from .. import __version__
from ..control import Controller
from ..models import Model


def files(name: str, what: Model | Controller) -> dict[str, str]:
    """Texts by file name; the build systems include everything deployed into the folder."""
    return {
        "CMakeLists.txt": _CMAKE,
        "library.json": _platformio(),
        "zephyr/module.yml": "name: deployed\nbuild:\n  cmake: zephyr\n",
        "zephyr/CMakeLists.txt": _ZEPHYR,
        f"{name}.md": _page(name, what),
    }


_CMAKE = """cmake_minimum_required(VERSION 3.10)
project(deployed C)
enable_testing()

# every NAME.c of this folder is a library NAME, with the test NAME_test
file(GLOB tests ${CMAKE_CURRENT_SOURCE_DIR}/*_test.c)
foreach(test ${tests})
  get_filename_component(file ${test} NAME_WE)
  string(REGEX REPLACE "_test$" "" name ${file})
  add_library(${name} STATIC ${CMAKE_CURRENT_SOURCE_DIR}/${name}.c)
  target_include_directories(${name} PUBLIC ${CMAKE_CURRENT_SOURCE_DIR})
  set_target_properties(${name} PROPERTIES C_STANDARD 99)
  # the bits of sewfast's own step: no fused multiply-add
  target_compile_options(${name} PRIVATE -ffp-contract=off)
  add_executable(${file} EXCLUDE_FROM_ALL ${test})
  target_link_libraries(${file} ${name})
  add_test(NAME ${name} COMMAND ${file})
endforeach()
"""

_ZEPHYR = """file(GLOB sources ${CMAKE_CURRENT_LIST_DIR}/../*.c)
list(FILTER sources EXCLUDE REGEX "_test\\.c$")
zephyr_library()
zephyr_library_sources(${sources})
zephyr_library_compile_options(-ffp-contract=off)
zephyr_include_directories(..)
"""


def _platformio() -> str:
    library = {
        "name": "deployed",
        "version": __version__,
        "description": "Written by sewfast",
        "license": "0BSD",
        "frameworks": "*",
        "platforms": "*",
        "build": {
            "srcFilter": ["+<*.c>", "-<*_test.c>"],
            "srcDir": ".",
            "includeDir": ".",
            "flags": ["-ffp-contract=off"],
        },
    }
    return json.dumps(library, indent=2) + "\n"


def _page(name: str, what: Model | Controller) -> str:
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
