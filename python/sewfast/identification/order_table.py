"""`OrderTable`: errors of linear models of every order and delay, and which one to use."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import Any, TypeAlias

import numpy as np

from .. import _core
from ..dataset import Dataset, FloatArray, labelled, require_dataset
from ..dataset.experiment import in_effect
from ..dataset.pieces import LARGEST_FITTED, require_fittable, require_sane
from ..dynamic_model import INIT
from ..errors import DataError, FitError, SettingError
from ..plotting import legend, lettered, stacked
from ..progress import shown_in_notebooks
from ..tables import Table, significant
from .delays import DelayEstimate, delay, reach

Progress: TypeAlias = Callable[[int, int, float], object]


@dataclass(frozen=True)
class Structure:
    """One row: a linear model's orders, the number of `parameters` that the data determine, and its
    errors. `one_step` and `free_run` are rms errors on later data [output unit], the latter also of
    its refinement by instrumental variables if that is better. The criteria are those of the ARX
    model on the same training samples (Ljung 1999, section 16.4); `lipschitz` is the index of He
    and Asada (1993) for these lags, relative to others.
    """

    na: int
    nb: int
    nk: int
    parameters: int
    one_step: float
    free_run: float
    aic: float
    aicc: float
    bic: float
    fpe: float
    lipschitz: float

    @property
    def orders(self) -> dict[str, int]:
        """Arguments of `identify`."""
        return {"na": self.na, "nb": self.nb, "nk": self.nk}


@dataclass(frozen=True, eq=False, repr=False)
class OrderTable:
    """Structures, the choice among them and its reason; prints itself.

    Attributes
    ----------
    rows : tuple of Structure
    choice : Structure
    reason : str
    delay : DelayEstimate or None
        None if the delays to try were given.
    output : str
        Name and unit of the output.
    """

    rows: tuple[Structure, ...]
    choice: Structure
    reason: str
    delay: DelayEstimate | None
    output: str

    @property
    def best(self) -> Structure:
        """The row with the lowest free-run error."""
        return min(self.rows, key=lambda r: r.free_run)

    def minimum(self, criterion: str) -> Structure:
        """The row with the lowest value of a column, such as `"bic"`."""
        if criterion not in Structure.__dataclass_fields__:
            raise SettingError(
                f"criterion: expected one of {', '.join(Structure.__dataclass_fields__)}, "
                f"received {criterion!r}"
            )
        least: Structure = min(self.rows, key=lambda r: getattr(r, criterion))
        return least

    def to_json(self) -> dict[str, Any]:
        """As JSON values; None if a number is not defined."""
        rows = [
            {k: v if math.isfinite(v) else None for k, v in asdict(r).items()} for r in self.rows
        ]
        return {
            "output": self.output,
            "choice": self.choice.orders,
            "reason": self.reason,
            "delay": self.delay and self.delay.to_json(),
            "rows": rows,
        }

    def plot(self, ax: Any = None, *, file: str | os.PathLike[str] | None = None) -> Any:
        """Draw the free-run error of every structure over its number of parameters.

        A line for each delay goes through its best structures; the choice is circled.

        Parameters
        ----------
        ax, file
            As for `Drawing.plot`.
        """
        return stacked([self._draw], (2.8,)).plot(ax, file)

    def _draw(self, ax: Any) -> None:
        for nk in sorted({row.nk for row in self.rows}):
            best: dict[int, float] = {}
            for row in self.rows:
                if row.nk == nk and math.isfinite(row.free_run):
                    size = row.na + row.nb
                    best[size] = min(row.free_run, best.get(size, math.inf))
            sizes = sorted(best)
            ax.plot(sizes, [best[s] for s in sizes], marker="o", markersize=3, label=f"nk = {nk}")
        chosen = self.choice
        label = f"choice: {chosen.na}, {chosen.nb}, {chosen.nk}"
        if math.isfinite(chosen.free_run):
            ax.plot(
                chosen.na + chosen.nb, chosen.free_run, linestyle="none", marker="o", markersize=10,
                markerfacecolor="none", markeredgecolor="black", label=label,
            )  # fmt: skip
        ax.set_xlabel("na + nb")
        ax.set_ylabel(lettered(f"free-run error of {self.output}, rms"))
        if ax.lines:
            legend(ax)

    def _shown(self, most: int = 12) -> list[Structure]:
        """The best structures, with the choice."""
        ranked = sorted(self.rows, key=lambda r: r.free_run)[:most]
        return ranked if self.choice in ranked else [*ranked[:-1], self.choice]

    def _repr_html_(self) -> str:
        """A table for a notebook: the best structures, the choice in bold."""
        shown = self._shown()
        rows = tuple(
            (f"{r.na} {r.nb} {r.nk}", *(significant(v, 5) for v in _numbers(r))) for r in shown
        )
        header = ("na nb nk", "free run", "one step", "AIC", "BIC", "FPE", "Lipschitz")
        best = frozenset((shown.index(self.choice), j) for j in range(len(header)))
        caption = f"Orders and delay, errors of {self.output} on later data"
        return Table(caption, header, rows, best).to_html([f"choice: {self.reason}"])

    def __str__(self) -> str:
        head = " na  nb  nk   free run   one step        AIC        BIC        FPE  Lipschitz"
        shown = self._shown()
        lines = [_line(r, "<- choice" if r is self.choice else "") for r in shown]
        left = len(self.rows) - len(shown)
        more = [f"    and {left} more, see `rows`"] if left else []
        by = {c: self.minimum(c) for c in ("aic", "aicc", "bic", "fpe", "one_step")}
        votes = "; ".join(f"{c} {r.na} {r.nb} {r.nk}" for c, r in by.items())
        orders = ", ".join(f"{k} = {v}" for k, v in self.choice.orders.items())
        return "\n".join(
            [
                f"Orders and delay, errors of {self.output} on later data",
                *([] if self.delay is None else [str(self.delay)]),
                head,
                *lines,
                *more,
                f"lowest: {votes}",
                f"choice: {orders}: {self.reason}",
            ]
        )

    __repr__ = __str__


def _numbers(r: Structure) -> tuple[float, ...]:
    return r.free_run, r.one_step, r.aic, r.bic, r.fpe, r.lipschitz


def _line(r: Structure, mark: str) -> str:
    numbers = " ".join(f"{v:10.5g}" for v in _numbers(r))
    return f"{r.na:3d} {r.nb:3d} {r.nk:3d} {numbers}  {mark}".rstrip()


@shown_in_notebooks("orders")
def orders(
    data: Dataset,
    *,
    na: int | Iterable[int] = 4,
    nb: int | Iterable[int] = 4,
    nk: int | Iterable[int] | None = None,
    validation: Dataset | None = None,
    held_out: float = 0.3,
    progress: Progress | None = None,
) -> OrderTable:
    """Try linear models of every order and delay on one data set.

    Parameters
    ----------
    data : Dataset
        Samples of weight 0 are omitted; other weights are ignored.
    na, nb : int or iterable of int
        Orders to try; a number n means 1 to n.
    nk : int, iterable of int, or None
        Delays to try; a number means that one delay. None: 1 and the plausible delays of
        `sewfast.delay`.
    validation : Dataset or None
        Data for the errors; None: the last part of each experiment.
    held_out : float
        Size of that part, between 0 and 1.
    progress : callable(done, total, lowest_error) or None
        If left out, a notebook shows a progress bar; None shows nothing.

    Returns
    -------
    OrderTable
        `identify(data, **table.choice.orders)` uses it.

    Raises
    ------
    DataError
        If the data are too short or never move.
    SettingError
        If a setting is out of its range.
    FitError
        If no structure has a finite free run.

    Notes
    -----
    The choice is the structure with the fewest parameters whose free-run error on later data is
    within 0.5 % of the lowest, or above it by no more than two standard errors of the difference
    over ten blocks (compare the one-standard-error rule: Hastie, Tibshirani, Friedman 2009, 7.10).
    Errors below 0.1 % of the output's standard deviation count as zero.
    Information criteria judge one-step errors, which hardly depend on the model at a high sampling
    rate; they are listed for comparison.
    """
    require_dataset(data, "data")
    data.require_inputs()
    data.require_excited()
    judged = in_effect(data)
    judged.require_measured(0)
    require_fittable(judged)
    train, later = (in_effect(part) for part in _parts(data, validation, held_out))
    found = delay(train, longest=reach(train)) if nk is None else None
    tried = _core.order_table(
        *([(e.u, e.y) for e in part.experiments] for part in (train, later)),
        na=_upto("na", na, 1),
        nb=_upto("nb", nb, 1),
        nk=_delays(nk, found),
        init=INIT,
        progress=progress,
    )
    errors = [blocks for *_, blocks, _, _ in tried]
    rows = [
        Structure(
            *orders, parameters, one_step, math.sqrt(blocks.mean()), aic, aicc, bic, fpe, index
        )
        for orders, parameters, one_step, blocks, (aic, aicc, bic, fpe), index in tried
    ]
    # error due to the unknown inputs before the later part, in standard deviations of the output
    exact = 1e-3 * float(np.nanstd(np.concatenate([e.y for e in later.experiments])))
    choice, reason = _chosen(rows, errors, exact)
    output = labelled(data.output_name, data.output_unit)
    return OrderTable(tuple(rows), choice, reason, found, output)


def _upto(name: str, value: int | Iterable[int], least: int) -> tuple[int, ...]:
    wanted = range(least, value + 1) if isinstance(value, int) else value
    return _whole(name, wanted, least)


def _whole(name: str, values: Iterable[int], least: int) -> tuple[int, ...]:
    found = tuple(sorted(set(values)))
    good = all(isinstance(v, (int, np.integer)) and least <= v <= 100 for v in found)
    if not found or not good:
        raise SettingError(
            f"{name}: expected whole numbers from {least} to 100, received {list(found)}"
        )
    return tuple(int(v) for v in found)


def _delays(nk: int | Iterable[int] | None, found: DelayEstimate | None) -> tuple[int, ...]:
    if nk is not None:
        return _whole("nk", (nk,) if isinstance(nk, int) else nk, 0)
    assert found is not None
    return _whole("nk", {1, found.nk, *(i.low for i in found.inputs)}, 0)


def _parts(data: Dataset, validation: Dataset | None, held_out: float) -> tuple[Dataset, Dataset]:
    if validation is None:
        if not 0.0 < held_out < 1.0:
            raise SettingError(f"held_out: expected a part between 0 and 1, received {held_out}")
        train, later = _split(data, 1.0 - held_out)
    else:
        require_dataset(validation, "validation")
        in_effect(validation).require_measured(0)
        require_sane(in_effect(validation), LARGEST_FITTED)
        Dataset.concat([data, validation])
        train, later = data, validation
    for e in later.experiments:
        if len(e) < 2 * INIT:
            raise DataError(
                f"{e.name}: expected at least {2 * INIT} later samples to judge on, received "
                f"{len(e)}; record longer, or raise held_out"
            )
    return train, later


def _split(data: Dataset, fraction: float) -> tuple[Dataset, Dataset]:
    from dataclasses import replace

    cuts = [max(1, min(len(e) - 1, round(fraction * len(e)))) for e in data.experiments]
    pairs = list(zip(data.experiments, cuts, strict=True))
    first = tuple(e.cut(0, k) for e, k in pairs)
    rest = tuple(e.cut(k, len(e)) for e, k in pairs)
    return replace(data, experiments=first), replace(data, experiments=rest)


def _chosen(rows: list[Structure], errors: list[FloatArray], exact: float) -> tuple[Structure, str]:
    best = min(range(len(rows)), key=lambda i: rows[i].free_run)
    if not math.isfinite(rows[best].free_run):
        raise FitError(
            "expected a structure with a finite free run, found none; check units and signs, or "
            "record with more excitation"
        )
    # ratio of free-run errors below which they count as equal: a tenth of the noise, if only that
    good = max(1.005 * rows[best].free_run, exact)
    able = [
        i
        for i, row in enumerate(rows)
        if row.free_run <= good or _is_not_worse(errors[i], errors[best])
    ]
    chosen = rows[min(able, key=lambda i: (rows[i].parameters, rows[i].free_run))]
    least = rows[best]
    if chosen is least:
        return chosen, "lowest free-run error on later data, and none as good has fewer parameters"
    ratio = 100.0 * (chosen.free_run / least.free_run - 1.0) if least.free_run > 0.0 else 0.0
    return chosen, (
        f"fewest parameters ({chosen.parameters}) among those whose free-run error on later data "
        f"is not distinguishable from the lowest ({least.na} {least.nb} {least.nk}: "
        f"{least.free_run:.5g}); it is {ratio:.1f} % above it"
    )


def _is_not_worse(errors: FloatArray, least: FloatArray) -> bool:
    """Whether the difference over the blocks is within two standard errors."""
    n = len(least)
    if n < 3 or len(errors) != n or not np.isfinite(errors).all():
        return False
    difference = errors - least
    return float(difference.mean()) <= 2.0 * float(difference.std(ddof=1)) / math.sqrt(n)
