"""Models and controllers as code for other processors and tools.

`deploy` writes a folder with C99 and its test against the step of sewfast, structured text, an FMU
or ONNX. Read in this order: `code` (`deploy`), `precision` (the steps that code computes, and what
single precision loses), then the forms: `c99`, `structured_text`, `fmi`, `onnx`; `emulated` (the
example firmware on a processor in QEMU); `command` adds `sewfast deploy` and `sewfast pil`.
"""

from typing import TYPE_CHECKING

from sewfast.plugins import on_first_use as _on_first_use

if TYPE_CHECKING:
    from .code import Deployment, deploy

__all__ = ["Deployment", "deploy"]

if not TYPE_CHECKING:  # a misspelt name is an error for type checkers
    __getattr__, __dir__ = _on_first_use(__name__, {"code": "Deployment deploy"})
