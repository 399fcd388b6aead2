"""From one recording of a motor drive to a verified controller, without risking the machine."""

from __future__ import annotations

# typing and importlib take longer to import than the rest: until `__main__` is read, Ctrl-C shows a
# traceback
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from . import rules, signals, trust
    from ._core import __version__
    from .analysis import Analysis, analyse
    from .causes import Cause, cause_of
    from .commissioning import Commissioning, bode, commission
    from .comparison import Comparison, compare
    from .control.biquad import Biquad
    from .control.controller import Controller, paper_controller
    from .control.feedforward import Feedforward
    from .control.files import load_controller
    from .control.loop import ClosedLoopRun, run
    from .control.machine import Machine
    from .control.margins import Margins, margins, operating_point
    from .control.position import PositionController
    from .control.record import record
    from .control.state_feedback import StateFeedback
    from .control.stops import PositionRun, follow_positions, stop_at
    from .dataset import Dataset, Diagnosis, Experiment, diagnose
    from .errors import (
        DataError,
        FitError,
        Interrupted,
        LinkError,
        ModelFileError,
        SettingError,
        SewfastError,
    )
    from .evidence import ReportCard, check
    from .frequency import (
        FrequencyResponse,
        ResponsesOverSpeed,
        ShaftFit,
        fit_shaft,
        load_response,
        load_responses,
    )
    from .gains import Gains
    from .greybox import Motor, load_motor, physics
    from .identification import identify
    from .identification.delays import DelayEstimate, delay
    from .identification.least_squares import LeastSquaresResult, least_squares
    from .identification.order_table import OrderTable, orders
    from .machine import VirtualMachine
    from .models import ARX, IV, Ensemble, LinearOE, Model, NeuralOE, NeuralSS, load_model
    from .moves import (
        Learned,
        MoveTable,
        Profile,
        Reach,
        Repetition,
        learn,
        load_table,
        plan,
        profile,
    )
    from .readers import read, read_joints, read_table
    from .recording import Recording
    from .rules import fit_fopdt, table_1
    from .speed import speed_from_counts
    from .storage import write_table
    from .tuning.front import ParetoFront, pareto
    from .tuning.objective import Constraints, Cost, LoadStep
    from .tuning.search import TuningResult, tune
    from .validation import Validation, validate

__all__ = [
    "ARX",
    "IV",
    "Analysis",
    "Biquad",
    "Cause",
    "ClosedLoopRun",
    "Commissioning",
    "Comparison",
    "Constraints",
    "Controller",
    "Cost",
    "DataError",
    "Dataset",
    "DelayEstimate",
    "Diagnosis",
    "Ensemble",
    "Experiment",
    "Feedforward",
    "FitError",
    "FrequencyResponse",
    "Gains",
    "Interrupted",
    "Learned",
    "LeastSquaresResult",
    "LinearOE",
    "LinkError",
    "LoadStep",
    "Machine",
    "Margins",
    "Model",
    "ModelFileError",
    "Motor",
    "MoveTable",
    "NeuralOE",
    "NeuralSS",
    "OrderTable",
    "ParetoFront",
    "PositionController",
    "PositionRun",
    "Profile",
    "Reach",
    "Recording",
    "Repetition",
    "ReportCard",
    "ResponsesOverSpeed",
    "SettingError",
    "SewfastError",
    "ShaftFit",
    "StateFeedback",
    "TuningResult",
    "Validation",
    "VirtualMachine",
    "__version__",
    "analyse",
    "bode",
    "cause_of",
    "check",
    "commission",
    "compare",
    "delay",
    "diagnose",
    "fit_fopdt",
    "fit_shaft",
    "follow_positions",
    "identify",
    "learn",
    "least_squares",
    "load_controller",
    "load_model",
    "load_motor",
    "load_response",
    "load_responses",
    "load_table",
    "margins",
    "operating_point",
    "orders",
    "paper_controller",
    "pareto",
    "physics",
    "plan",
    "profile",
    "read",
    "read_joints",
    "read_table",
    "record",
    "rules",
    "run",
    "signals",
    "speed_from_counts",
    "stop_at",
    "table_1",
    "trust",
    "tune",
    "validate",
    "write_table",
]

# names are loaded on first use, so that `import sewfast` and `sewfast --help` are fast
_HOMES = {
    "_core": "__version__",
    "commissioning": "Commissioning bode commission",
    "comparison": "Comparison compare",
    "analysis": "Analysis analyse",
    "causes": "Cause cause_of",
    "control": "Biquad Controller Gains fit_fopdt load_controller paper_controller table_1",
    "control.feedforward": "Feedforward",
    "control.state_feedback": "StateFeedback",
    "tuning": "Constraints Cost LoadStep ParetoFront TuningResult pareto tune",
    "dataset": "Dataset Diagnosis Experiment diagnose",
    "identification.delays": "DelayEstimate delay",
    "errors": "DataError FitError Interrupted LinkError ModelFileError SettingError SewfastError",
    "evidence": "ReportCard check",
    "frequency": "FrequencyResponse ResponsesOverSpeed ShaftFit fit_shaft load_response "
    "load_responses",
    "greybox": "Motor load_motor physics",
    "identification": "identify",
    "identification.least_squares": "LeastSquaresResult least_squares",
    "control.loop": "ClosedLoopRun run",
    "control.machine": "Machine",
    "control.record": "record",
    "machine": "VirtualMachine",
    "models": "ARX IV Ensemble LinearOE Model NeuralOE NeuralSS load_model",
    "identification.order_table": "OrderTable orders",
    "readers": "read read_joints read_table",
    "recording": "Recording",
    "moves": "Learned MoveTable Profile Reach Repetition learn load_table plan profile",
    "control.margins": "Margins margins operating_point",
    "control.position": "PositionController",
    "control.stops": "PositionRun follow_positions stop_at",
    "speed": "speed_from_counts",
    "validation": "Validation validate",
    "storage": "write_table",
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    from importlib import import_module

    if name in _HOME_OF:
        value = getattr(import_module(f".{_HOME_OF[name]}", __name__), name)
    elif name in __all__:
        value = import_module(f".{name}", __name__)
    elif name.startswith("_") or _is_module(name):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    else:
        from sewfast.plugins import public_name

        value = public_name(name)
    globals()[name] = value
    return value


def _is_module(name: str) -> bool:
    """`from . import units` asks for an attribute first; the metadata of all packages take long."""
    from importlib.machinery import PathFinder

    spec = PathFinder.find_spec(f"{__name__}.{name}", __path__)
    # a folder that an older version left behind has no origin
    return spec is not None and spec.origin is not None


def __dir__() -> list[str]:
    from sewfast.plugins import public_names

    return sorted({*globals(), *__all__, *public_names()})
