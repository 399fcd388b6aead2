"""`plan`: the table of a known move, from the models of a drive."""

from __future__ import annotations

import math
from collections.abc import Callable

from numpy.typing import ArrayLike

from .. import _core
from ..control.controller import SampledController
from ..control.loop import (
    Plant,
    Plants,
    check_fits,
    common_rest,
    cores_about,
    each_plant,
    reference_samples,
    require_controller,
    usual_reference,
)
from ..control.move import MoveTable
from ..errors import Interrupted, SettingError
from ..gains import whole
from ..progress import shown_in_notebooks
from ..threads import available
from .profiles import profile


@shown_in_notebooks("plan", "error")
def plan(
    controller: SampledController,
    models: Plants,
    reference: str | ArrayLike | None = None,
    *,
    within_reach: bool = False,
    name: str | None = None,
    seed: int = 0,
    threads: int | None = None,
    progress: Callable[[int, int, float], object] | None = None,
) -> MoveTable:
    """Find the table of a known move: the reference that makes the models follow the wanted one.

    Gauss and Newton's method on the closed loops of all models: the least mean square of their
    tracking errors, with a small weight on the change of the command. Where the models part, the
    table claims no more than they agree on. The limits of the command are part of the loops.

    Parameters
    ----------
    controller : Controller or StateFeedback
        With or without feedforward; it is not changed. A ramp (`r_rate`) is refused.
    models : Model or sequence of them
        Of an ensemble each member counts. A virtual machine is a model, too.
    reference : str or array, shape (N,), optional
        As for `run`; a trapezoid that suits the first model by default [y].
    within_reach : bool
        Replace the reference by one that the models can follow (`profile`): a step becomes the
        quickest way to its level.
    name : str, optional
        Name of the reference in messages and files.
    seed : int
        Of a named random reference.
    threads : int, optional
        By default all that are available; the result does not depend on it.
    progress : callable, optional
        Called with steps done, steps in all and the rms error [y].

    Returns
    -------
    MoveTable
        `expected` has the error of the models without the table and with it.

    Raises
    ------
    SettingError
        If sample times or units of controller, models and reference disagree, or for a ramp.
    DataError
        For a reference that is empty or not finite.
    FitError
        If a loop diverges along the reference.
    Interrupted
        On Ctrl-C; `best` is the best table so far.

    Notes
    -----
    A reference that is shaped beforehand is as good as a command that is added behind the
    controller, and everything that runs the controller can play it (docs: "Learn a move").
    """
    require_controller(controller, models, "plan(controller, models, reference)", SampledController)
    plants = plants_of(controller, models)
    if reference is None:
        reference, name = usual_reference(plants[0], controller), name or "trapezoid"
    r = reference_samples(reference, controller, seed, plant=plants[0])
    if within_reach:
        r = profile(r, plants, u_min=controller.u_min, u_max=controller.u_max).r
    rest = common_rest(plants)
    found = _core.plan_move(
        cores_about(rest, plants), controller.about(rest).core(), r - rest.y,
        counted=controller.counts_per_unit > 0.0,
        threads=whole("threads", available() if threads is None else threads), progress=progress,
    )  # fmt: skip
    setpoint = found["setpoint"] + rest.y
    table = MoveTable(
        reference=r, setpoint=setpoint, planned=setpoint, u=found["u"] + rest.u[0],
        y=found["y"] + rest.y, controller=controller,
        name=name or (reference if isinstance(reference, str) else "reference"),
        errors=tuple(found["errors"]), limited=found["limited"],
    )  # fmt: skip
    if found["interrupted"]:
        raise Interrupted(table)
    return table


def plants_of(controller: SampledController, models: Plants) -> list[Plant]:
    """The single plants, each of which fits the controller; a ramp is refused."""
    plants = each_plant(models)
    if not plants:
        raise SettingError(
            name="models", expected="at least one", received="none",
            remedy="read one with load_model",
        )  # fmt: skip
    for plant in plants:
        check_fits(controller, plant)
    if math.isfinite(getattr(controller, "r_rate", math.inf)):
        raise SettingError(
            name="r_rate", expected="a controller without a ramp, which would cut off a table",
            received=f"{controller.r_rate:g}",  # type: ignore[attr-defined]
            remedy="set r_rate to inf and give a reference within reach (sewfast profile)",
        )  # fmt: skip
    return plants
