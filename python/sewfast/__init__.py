"""From one recording of a motor drive to a verified controller, without risking the machine."""

from ._core import __version__

__all__ = ["__version__"]
