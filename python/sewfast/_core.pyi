"""Types of the compiled module. Arrays are C-contiguous float64; inputs are ``(N, n_inputs)``, time first."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypedDict, final

import numpy as np
from numpy.typing import NDArray
from typing_extensions import disjoint_base

__version__: str
cpu: Literal["baseline", "avx2", "avx512"]  # what the kernels run on; SEWFAST_CPU forces one

_F: TypeAlias = NDArray[np.float64]
_Experiments: TypeAlias = Sequence[tuple[_F, ...]]  # (u, y) or (u, y, weights), weights (N,) >= 0
_Progress: TypeAlias = Callable[[int, int, float], object] | None

# --- signals.rs: every one returns float64 (N,); N = round(duration / Ts) ---------------------------------

def step(*, duration: float, Ts: float, at: float, low: float, high: float) -> _F: ...
def staircase(*, Ts: float, levels: _F, hold: float) -> _F: ...
def trapezoid(
    *, duration: float, Ts: float, start: float, rise: float, hold: float, fall: float,
    low: float, high: float,
) -> _F: ...
def chirp(
    *, duration: float, Ts: float, f_start: float, f_end: float, amplitude_start: float,
    amplitude_end: float, offset_start: float, offset_end: float,
    sweep: Literal["linear", "logarithmic"] = "linear", phase: float = ...,
) -> _F: ...
def random_steps(
    *, duration: float, Ts: float, low: float, high: float, hold_min: float, hold_max: float,
    smoothing: float, seed: int, start: float | None = None,
) -> _F:
    """Half-cosine changes of ``smoothing`` seconds; with ``start`` the signal begins there."""
def prbs(*, duration: float, Ts: float, low: float, high: float, hold: float, seed: int) -> _F:
    """Maximum length sequence of the shortest register whose period covers the signal."""
def multisine(
    *, duration: float, Ts: float, f_low: float, f_high: float, amplitude: float, offset: float,
    seed: int,
) -> _F: ...
def jumps(
    *, duration: float, Ts: float, speed_low: float, speed_high: float, change_min: float,
    level_min: float, level_max: float, hold_min: float, hold_max: float, ramp: float, gain: float,
    acceleration: float, seed: int,
) -> _F:
    """Pulses that saturate a drive, between random speeds that ``speed / gain`` then holds."""
def limit(signal: _F, *, Ts: float, low: float, high: float, rate: float, slew: float) -> _F:
    """Amplitude in [low, high], first difference at most ``rate`` per second, second at most ``slew`` per s^2."""
def crest_factor(signal: _F) -> float: ...

# --- machine.rs -------------------------------------------------------------------------------------------

@final
class Machine:
    """The virtual sewing machine; see docs/CONVENTIONS.md for its parameters.

    Counts are float64: whole numbers where ``quantisation`` is 1, the exact position in counts where it is 0.
    """

    def __new__(cls, parameters: Mapping[str, float] | None = None) -> Machine:
        """Parameters by name; others keep their defaults."""
    @staticmethod
    def default_parameters() -> dict[str, float]: ...
    @staticmethod
    def variant_parameters(seed: int) -> dict[str, float]: ...
    @staticmethod
    def parameter_units() -> dict[str, str]: ...
    @property
    def parameters(self) -> dict[str, float]: ...
    def reset(self) -> None: ...
    def set_load(self, torque: float) -> None:
        """Apply a constant load torque [N m] from now on, also after resets; 0 removes it."""
    def step(self, u: float) -> tuple[float, float]:
        """Hold ``u`` [V] for one sample; counts and true speed [RPM] at its end."""
    def run(self, u: _F) -> tuple[_F, _F]:
        """Counts and true speed [RPM] at the instants at which u(k) starts to act: entry 0 is before u[0] acts.

        Continues from the present state: call ``reset`` for a run from rest.
        """
    def linearise(self, speed_rpm: float) -> dict[str, float]:
        """Small signals about a steady speed: command [V], current [A], gain [RPM/V], T1 and T2 [s]."""
    def __reduce__(self) -> tuple[type[Machine], tuple[dict[str, float]], list[float]]: ...
    def __setstate__(self, memory: Sequence[float]) -> None: ...
    @property
    def counts(self) -> float: ...
    @property
    def speed_rpm(self) -> float: ...
    @property
    def current(self) -> float: ...

# --- speed.rs: counts are float64 (N,), whole numbers unless the encoder's quantisation is off ---------------

def speed_difference(counts: _F, *, Ts: float, counts_per_unit: float) -> _F: ...
def speed_savgol(counts: _F, *, Ts: float, counts_per_unit: float, window: int, order: int) -> _F: ...
def speed_kalman(
    counts: _F, *, Ts: float, counts_per_unit: float, process_noise: float | None = None,
    ripple_orders: Sequence[int] = ..., counts_per_rev: float = 1.0,
) -> _F:
    """RTS smoother; the process noise [unit^2/s^3] is estimated by maximum likelihood if None.

    With ``ripple_orders`` a load that repeats over the turn is modelled too, if that is more likely.
    """
def unwrap_counts(counts: _F, *, bits: int) -> _F: ...

# --- greybox.rs -------------------------------------------------------------------------------------------

GREYBOX_JOINT: list[str]
GREYBOX_PARAMETERS: list[str]

def greybox_run(
    theta: _F, free: Sequence[int], u: _F, *, Ts: float, steps: int, speed: float = 0.0,
    mean: bool = False, angle: _F | None = None, orders: Sequence[int] = ...,
) -> tuple[_F, _F, _F, _F]:
    """Speed [rad/s] and drive [command] (N,), and their derivatives by the free parameters (N, n_free)."""
def greybox_normal(
    theta: _F, free: Sequence[int], u: _F, y: _F, used: NDArray[np.bool_], *, Ts: float, steps: int,
    filter: _F, speed: float = 0.0, mean: bool = False, angle: _F | None = None,
    orders: Sequence[int] = ..., current: tuple[_F, _F, float] | None = None,
) -> tuple[float, _F, _F]:
    """Cost, gradient (n,) and Gram matrix (n, n) of filtered errors, by the free and last the resistance.

    ``current``: samples [A], filter and resistance [command/A].
    """

def greybox_regressed(
    experiments: _Experiments, *, width: float, delays: Sequence[float], Ts: float,
    unit: float, k_q: float,
) -> list[tuple[float, float, float, float] | None]:
    """What drives a joint per speed, acceleration, sign of the speed and at all, of signals smoothed over ``width``
    samples, for each delay [samples]; None with too few samples.
    """
def greybox_waves(
    experiments: _Experiments, *, width: float, delay: float, Ts: float, unit: float, k_q: float,
    orders: Sequence[float],
) -> list[float]:
    """Squares that friction, inertia, gravity and a wave of each order over the position leave of what drives a joint."""
def minimised(
    normal: Callable[[_F], tuple[float, _F, _F]], cost: Callable[[_F], float], start: _F, low: _F, high: _F, *,
    count: float, enough: float, iterations: int,
) -> tuple[_F, float, float, BaseException | None]:
    """Least squares within bounds: parameters, cost, squared distance to the minimum in standard errors, and the
    exception that ended the descent after its start.
    """
def sandwich_covariance(
    jacobian: _F, residuals: _F, lengths: Sequence[int], *, channels: int = 1, known: _F | None = None,
) -> _F:
    """Covariance (n, n) of an estimate from sums of scores over windows; rows by piece, then channel."""
def inverse_root(matrix: _F) -> tuple[_F, _F]:
    """Root of the inverse, (n, determined directions), and a huge covariance of the other directions, (n, n)."""

@final
class Tracker:
    """Motor parameters followed online: ``k_v``, ``k_a``, ``k_s``, ``offset``."""

    def __new__(
        cls, *, Ts: float, smoothing: float, lag: float, memory: float, speed: float
    ) -> Tracker: ...
    def reset(self) -> None: ...
    def step(self, u: float, y: float) -> None: ...
    def run(self, u: _F, y: _F) -> tuple[_F, NDArray[np.bool_]]:
        """Estimates, and whether each has moved, after each sample, (N, 4)."""
    @property
    def estimate(self) -> list[float]: ...
    @property
    def variance(self) -> list[float]: ...
    @property
    def moved(self) -> list[bool]: ...
    def watch(self, reference: Sequence[float], tolerance: Sequence[float]) -> None: ...

# --- models.rs --------------------------------------------------------------------------------------------

@final
class EmbeddedModel:
    """A model's coefficients by name, and its step in the arithmetic of a microcontroller."""

    @property
    def kind(self) -> str:
        """``linear``, ``network`` or ``states``."""

    @property
    def orders(self) -> dict[str, int]:
        """na (past outputs, or states), nb, nk, inputs."""

    @property
    def parts(self) -> dict[str, _F]:
        """Coefficients by their names in the Rust crate's ``model``; matrices row by row."""

    @property
    def scaling(self) -> dict[str, _F] | None:
        """u_mean, u_scale, y_mean, y_scale around the equation."""

    @property
    def output(self) -> tuple[str, list[float]]:
        """Name and parameters of the output function."""

    def run(self, u: _F, state: _F, held: _F, *, precision: str = "f64") -> _F:
        """Free run over u, (N, inputs), from a state, with inputs of ``held`` before; (N,)."""

def tanh_quotients() -> dict[str, tuple[list[float], list[float], float]]:
    """tanh(x) = x P(x^2)/Q(x^2): P, Q and the largest |x| of ``near``, ``far`` and ``single``."""

@disjoint_base
class Model:
    """A compiled model of any kind, which adds its own parameters. States are past outputs, newest first, or the model's own."""

    @property
    def theta(self) -> _F:
        """All parameters (docs/CONVENTIONS.md, Models)."""
    def rest_state(self) -> _F:
        """State of a drive at rest."""
    def simulate(self, u: _F, state: _F) -> _F: ...
    def predict(self, u: _F, y: _F, state: _F, horizon: int) -> _F: ...
    def estimate_initial_state(self, u: _F, y: _F) -> _F:
        """NaN in y does not count."""
    def jacobian(self, u: _F, state: _F) -> tuple[_F, _F]:
        """Free run (N,) in the data's units and its sensitivities (N, n_theta + n_state): theta, then the state."""
    def linearise(self, u: _F, state: _F) -> tuple[_F, _F, _F, _F]:
        """A (n, n), B (n, nu), C (ny, n), D (ny, nu) of one step about inputs (nu,) and a state (n,), in the data's units.

        x+ = A x + B v, y = C x + D v with v(k) = u(k - nk). The state of a lagged model is [y(k-1) .. y(k-na)], then of one
        input after the other [v(k-1) .. v(k-nb+1)]: n = na + nu (nb - 1). That of a state-space model is its own.
        """
    def embedded(self, *, scaled: bool = False) -> EmbeddedModel:
        """Step for a microcontroller, in the data's units like ``simulate``, or ``scaled``."""

@final
class LinearModel(Model):
    """y(k) = -sum_i a[i] y(k-1-i) + sum_j sum_i b[j, i] u_j(k-nk-i) + offset, in the data's units; theta = [a, b, offset]."""

    def __new__(cls, a: _F, b: _F, nk: int, offset: float) -> LinearModel: ...
    @property
    def a(self) -> _F: ...
    @property
    def b(self) -> _F: ...
    @property
    def nk(self) -> int: ...
    @property
    def offset(self) -> float: ...
    @property
    def na(self) -> int: ...
    @property
    def is_stable(self) -> bool: ...
    def poles(self) -> _F:
        """Real and imaginary parts, (na, 2)."""
    def dc_gain(self) -> _F:
        """Steady gain from each input, (n_inputs,)."""

@final
class NeuralOE(Model):
    """Network output-error model; theta = [W1 (H, n_phi) row by row, b1 (H), w2 (H), b2, linear (n_phi)]."""

    def __new__(
        cls, *, na: int, nb: int, nk: int, n_inputs: int, hidden: int, bypass: bool, theta: _F,
        u_mean: _F, u_scale: _F, y_mean: float, y_scale: float,
        output_low: float | None, output_high: float | None,
    ) -> NeuralOE: ...
    @property
    def settings(self) -> dict[str, object]:
        """Every constructor argument but theta."""
    @property
    def na(self) -> int: ...

@final
class NeuralSS(Model):
    """Neural state-space model (docs/CONVENTIONS.md); theta = [A, B, E, Wx, Wu, bh, C, D, c, G], row by row.

    States are in scaled units. Of outputs there is one: ``n_outputs`` is 1, and its mean, scale and variance are (1,).
    """

    def __new__(
        cls, *, nx: int, nk: int, n_inputs: int, n_outputs: int, hidden: int, integrator: bool,
        output: Literal["linear", "saturation", "abs"], output_parameters: _F, theta: _F, u_mean: _F,
        u_scale: _F, y_mean: _F, y_scale: _F, state_mean: _F, state_covariance: _F, residual_variance: _F,
        process_noise: float,
    ) -> NeuralSS:
        """``output_parameters``: (), (low, high, w) or (w,), in scaled units; ``state_covariance`` (nx, nx)."""
    @property
    def settings(self) -> dict[str, object]:
        """Every constructor argument but theta."""
    @property
    def nx(self) -> int: ...
    @property
    def nk(self) -> int: ...
    def slowed(self, factor: float) -> NeuralSS:
        """The model with the same steady states, reached more slowly by a factor."""
    def grown(self, nx: int, hidden: int, seed: int) -> NeuralSS:
        """The same model with more states and hidden units, as the start of a larger one.

        It keeps all weights; new units act on the rest with weights of about 1e-3, so that the free run hardly
        changes. New states come after the old ones, before an integrated one. Smaller sizes raise a SettingError.
        """
    def states(self, u: _F, state: _F) -> _F:
        """States of the free run, (N, nx)."""

GREYBOX_UNITS: int

@final
class GreyBox(Model):
    """A motor's equations with a network for the rest; theta = [free parameters, (b, p, q, c) of each unit]."""

    def __new__(
        cls, *, values: _F, free: Sequence[int], Ts: float, steps: int, mean: bool, unit: float,
        speed_scale: float, command_scale: float, residual_variance: float, process_noise: float,
        theta: _F, position: bool = False, joint: Sequence[float] = ...,
    ) -> GreyBox:
        """``values`` in the order of GREYBOX_PARAMETERS, ``joint`` in that of GREYBOX_JOINT, ``free`` places in both.

        ``unit`` of the output [rad/s, of a position rad].
        """
    @property
    def settings(self) -> dict[str, Any]:
        """Every constructor argument but theta; nx, nk, n_inputs, hidden, integrator."""
    def states(self, u: _F, state: _F) -> _F:
        """States of the free run, (N, 3), of a position (N, 4)."""
    def descended(
        self, experiments: _Experiments, *, prior: _F, low: _F, high: _F, enough: float, iterations: int,
        progress: _Progress = None,
    ) -> tuple[GreyBox, float, _F]:
        """Least squares of a position over pieces from theta: the model, its cost and the initial states (pieces, nx).

        ``prior``: inverse standard deviations of theta about 0, in units of the residuals.
        """
    def first_states(self, experiments: _Experiments) -> _F:
        """States at which pieces begin, from their first outputs, (pieces, nx)."""
    def squares(self, experiments: _Experiments, states: _F) -> float:
        """Weighted squared errors of free runs over pieces; infinite if one diverges."""
    def covariance(
        self, experiments: _Experiments, states: _F
    ) -> tuple[_F, NDArray[np.bool_]]:
        """Covariance of theta at the pieces' least squares, (p, p), and which of it is determined, (p,)."""
    def independent(self, experiments: _Experiments, states: _F) -> float:
        """Number of samples that are as good as independent."""

@final
class HammersteinWiener(Model):
    """A linear difference equation between static curves; theta = [a, b, offset, bends of f, log slopes of g]."""

    def __new__(
        cls, *, na: int, nb: int, nk: int, input_low: _F, input_high: _F, input_pieces: int,
        x_low: float, x_high: float, output_pieces: int, theta: _F,
    ) -> HammersteinWiener:
        """Ranges of the curves: of each input (n_inputs,), and of the linear part's output."""
    @property
    def settings(self) -> dict[str, object]:
        """Every constructor argument but theta."""
    def input_curve(self, input: int, u: _F) -> _F:
        """f of one input at values of it, (N,)."""
    def output_curve(self, x: _F) -> _F:
        """g at values of the linear part's output, (N,)."""

@final
class HammersteinWienerFit:
    """A fitted Hammerstein-Wiener model with the record of its fit."""

    @property
    def model(self) -> HammersteinWiener: ...
    @property
    def cost(self) -> float:
        """1/(2N) sum e^2 in free run, in the output's unit squared."""
    @property
    def iterations(self) -> int: ...
    @property
    def termination(self) -> str: ...
    @property
    def remedy(self) -> str: ...
    @property
    def trace(self) -> _F: ...
    @property
    def initial_states(self) -> _F:
        """Past outputs of each experiment, newest first, (n_experiments, na)."""

@final
class LinearFit:
    """A fitted linear model with the record of its fit."""

    @property
    def model(self) -> LinearModel: ...
    @property
    def cost(self) -> float: ...
    @property
    def iterations(self) -> int: ...
    @property
    def termination(self) -> str: ...
    @property
    def remedy(self) -> str:
        """What to do about the termination."""
    @property
    def trace(self) -> _F: ...
    @property
    def initial_states(self) -> _F:
        """Past outputs before the first measured sample of each experiment, newest first, (n_experiments, na)."""
    @property
    def covariance(self) -> _F:
        """Of [a, b input by input, offset] for white measurement noise, (n_theta, n_theta).

        Zero for an offset that was not estimated; inf if the data do not determine the parameters.
        """
    @property
    def standard_errors(self) -> _F:
        """Square roots of its diagonal, (n_theta,)."""

@final
class NeuralFit:
    """A trained network with the record of its training."""

    @property
    def model(self) -> NeuralOE: ...
    @property
    def cost(self) -> float:
        """J = 1/(2N) sum e^2 in scaled units, free run, on the training data."""
    @property
    def validation_cost(self) -> float | None: ...
    @property
    def iterations(self) -> int: ...
    @property
    def trials(self) -> int:
        """Steps tried by the chosen start."""
    @property
    def termination(self) -> str: ...
    @property
    def remedy(self) -> str:
        """What to do about the termination."""
    @property
    def trace(self) -> _F: ...
    @property
    def start(self) -> int:
        """Index of the chosen start."""
    @property
    def start_costs(self) -> _F:
        """J that each start was judged by: on validation data, else on training data; inf: failed."""
    @property
    def discarded(self) -> int:
        """Dead starts that were drawn again."""
    @property
    def models(self) -> list[NeuralOE]:
        """Models of all starts with a finite cost, sound ones first, then by cost: an ensemble."""
    @property
    def sound(self) -> bool:
        """Whether the model passes the guard on the training data (see `guard`); if not, no start does."""
    @property
    def initial_states(self) -> _F:
        """Past outputs before the first simulated sample of each training experiment, newest first, (n_experiments, na)."""

def fit_arx(experiments: _Experiments, *, na: int, nb: int, nk: int, offset: bool) -> LinearModel:
    """In every fit an output that is NaN has no weight; inputs are finite. Costs are sum w e^2 / (2 sum w)."""

def fit_iv(
    experiments: _Experiments, *, na: int, nb: int, nk: int, offset: bool = True,
    max_iterations: int = 50, progress: _Progress = None,
) -> LinearFit:
    """Refined instrumental variables (SRIV); "small_step" is the only success. Weights other than 1 are refused."""

def fit_innovations(
    experiments: _Experiments, *, nk: int | None = None, max_iterations: int = 60, progress: _Progress = None
) -> LinearFit:
    """ARMAX by the prediction error, its order and delay by the BIC; `cost` is of one step, poles may be unstable."""

@final
class NeuralSSFit:
    """A trained state-space model with the record of its training."""

    @property
    def model(self) -> NeuralSS: ...
    @property
    def cost(self) -> float:
        """J = 1/(2N) sum e^2 in scaled units, free run, on the training data's known outputs."""
    @property
    def validation_cost(self) -> float | None: ...
    @property
    def iterations(self) -> int: ...
    @property
    def termination(self) -> str: ...
    @property
    def remedy(self) -> str:
        """What to do about the termination."""
    @property
    def trace(self) -> _F: ...
    @property
    def start(self) -> int:
        """Index of the chosen one of these starts, from 0."""
    @property
    def start_costs(self) -> _F:
        """J that each start was judged by: on validation data, else on training data; inf: failed."""
    @property
    def discarded(self) -> int:
        """Dead starts that were drawn again."""
    @property
    def models(self) -> list[NeuralSS]:
        """Models of all starts with a finite cost, sound ones first, then by cost: an ensemble."""
    @property
    def start_models(self) -> list[NeuralSS | None]:
        """The model of each start, in order; None: failed, or not begun before Ctrl-C."""
    @property
    def sounds(self) -> list[bool]:
        """Whether each start's model passes the guard on the training data; all True if it was not applied."""
    @property
    def sound(self) -> bool:
        """The same for the chosen model; if False, no start passes."""
    @property
    def initial_states(self) -> _F:
        """State of each training experiment, (n_experiments, nx)."""

def fit_hammerstein_wiener(
    experiments: _Experiments, *, na: int, nb: int, nk: int, input_pieces: int, output_pieces: int,
    max_iterations: int = 100, progress: _Progress = None,
) -> HammersteinWienerFit: ...
def fit_oe(
    experiments: _Experiments, *, na: int, nb: int, nk: int, offset: bool = True,
    max_iterations: int = 100, initial: LinearModel | None = None, progress: _Progress = None,
) -> LinearFit:
    """Output error. ``initial``, of these orders, replaces the search over many starts.

    Ctrl-C gives the best model so far as "interrupted"; its initial states and cost can then be those of an excerpt.
    """
def fit_neural_oe(
    experiments: _Experiments, validation: _Experiments, *, na: int, nb: int, nk: int, hidden: int,
    linear: LinearModel | None, u_mean: _F | None, u_scale: _F | None, y_mean: float | None,
    y_scale: float | None, saturate: float | None, initial_state: Literal["zero", "measured", "estimated"],
    weight_decay: float, max_iterations: int, starts: int, seed: int, threads: int,
    initial_theta: _F | None = None, progress: _Progress = None,
) -> NeuralFit:
    """Train in free run; the start is chosen by J on ``validation``, or on the training data without it.

    With ``linear``, of the same orders, the network gets a bypass and starts exactly there; without, small random
    weights and no bypass. ``saturate`` widens the training output's range by that fraction (half at each end) and
    clips the output there, without slope outside; None leaves it linear. ``threads = 0`` uses all; the bits do not
    depend on it. ``initial_state`` 'measured' starts each run after its first na samples.
    ``initial_theta``, in scaled units, replaces the random starts, (starts, n_theta).
    """

def fit_neural_ss(
    experiments: _Experiments, validation: _Experiments, *, nx: int, nk: int, hidden: int,
    linear: LinearModel | None, output: Literal["linear", "saturation", "abs"], output_parameters: _F,
    integrator: bool, weight_decay: float, hidden_scale: float, max_iterations: int, starts: int,
    first_start: int, seed: int, threads: int, initial: Sequence[NeuralSS] | None = None,
    guard: bool = True, progress: _Progress = None,
) -> NeuralSSFit:
    """Train in free run; each start is stopped and judged on ``validation``, without it on the training data.

    NaN in y has no weight. Scaled units are means and standard deviations of the training data;
    with output 'abs' y_mean is 0 and y_scale the root mean square. ``linear`` has na = nx, nb <= nx + 1 and the same nk;
    without it a start begins with random states. Start i of the seed is ``first_start + i`` here: starts spread over
    several calls, or over threads (0 uses all), have the same bits. With ``initial`` nothing is drawn: start i trains
    the i-th of these models further, in their scaling; they are of one shape and as many as ``starts``.
    ``guard`` applies `guard` to each start's model on these experiments, with ``linear``; on short pieces of records it
    has little power, so that a search on pieces leaves it out and applies it to whole records.
    """

def convex_weights(residuals: _F, weights: _F) -> _F:
    """Weights w >= 0 of sum 1, (models,), with the least sum of weights (residuals w)^2; residuals are (rows, models)."""

def guard(
    model: LinearModel | NeuralOE | NeuralSS, experiments: _Experiments, *, linear: Sequence[LinearModel] = ...,
) -> str:
    """The reason why the model is not sound on these whole records, to follow "the model"; "" for a sound one.

    It must have a finite free run, stay within a width of the output's range on inputs a quarter larger, forget its
    initial state, stay near the range with its inputs' blocks in another order, and then agree with the run in the
    record's order (8 blocks of 100 samples or more). If the ``linear`` models of the same records deviate more, 1.5
    times their deviation is allowed. An integrator only has to pass the first two tests, and to move at speeds like
    its record's. Of an experiment the first 20,000 samples count. Ctrl-C raises KeyboardInterrupt.
    """

# --- least_squares.rs --------------------------------------------------------------------------------------

def least_squares_fit(
    fun: Callable[[_F], _F], jac: Callable[[_F, _F], _F], x0: _F, first: _F, *,
    lower: _F | None, upper: _F | None, x_scale: _F | None, ftol: float, xtol: float, gtol: float,
    max_nfev: int, precision: float,
) -> dict[str, Any]:
    """``first`` is fun(x0); jac gets x and fun(x). Ctrl-C ends it as "interrupted"; other exceptions propagate."""

# --- control.rs -------------------------------------------------------------------------------------------

_Form: TypeAlias = Literal["standard", "parallel", "per_sample"]

def convert_gains(
    gains: tuple[float, float, float], *, form: _Form, to: _Form, Ts: float,
) -> tuple[float, float, float]: ...

@final
class SingleController:
    """The controller's arithmetic in single precision, as on a microcontroller."""

    def step(self, r: float, y: float, feedforward: float = 0.0) -> float: ...
    def set_design(self, other: SingleController) -> None:
        """As ``Controller.set_design``."""

    def set_manual(self, u: float) -> None: ...
    def set_automatic(self) -> None: ...
    @property
    def manual(self) -> bool: ...
    def reset(self) -> None: ...
    @property
    def filtered(self) -> float: ...
    @property
    def numbers(self) -> dict[str, Any]:
        """The constants of the step: as ``Controller.numbers``, in single precision."""

def biquad(kind: str, numbers: Sequence[float], *, Ts: float) -> tuple[float, float, float, float]:
    """c0, c1, a1, a2 of 1 + (1 - q)(c0 + c1 q)/(1 + a1 q + a2 q^2), q = 1/z: a ``notch`` (frequency [Hz], depth, width), ``low_pass``
    (frequency, damping), ``lead_lag`` (zero, pole) or ``resonance`` (zero frequency, damping, pole frequency, damping).
    """

def inverse_taps(
    points: Sequence[tuple[_F, _F, _F, float, int, float]],
    choices: Sequence[tuple[int, float]], *, count: int,
) -> list[list[float]]:
    """The taps of a feedforward for each preview and smoothing, on plants about levels: A, B, C, D of one input, its delay and
    the slope of the command over the level."""

@final
class Controller:
    """The controller's arithmetic, one sample at a time (paper Fig. 16). Gains in standard form."""

    def __new__(
        cls, *, Kp: float, Ti: float, Td: float, alpha: float, beta: float, N: float, Tt: float,
        u_min: float, u_max: float, slew: float, Ts: float, filter_samples: int, filter_time: float,
        observer_time: float = 0.0, r_rate: float = ...,
        schedule: Sequence[tuple[float, float, float, float]] = ...,
        biquads: Sequence[tuple[float, float, float, float]] = ...,
        feedforward: tuple[int, float, list[tuple[float, float]], list[float]] | None = ...,
    ) -> Controller:
        """``schedule`` has rows of speed, Kp, Ti, Td; empty for constant gains. ``biquads`` are rows of `biquad`."""

    def step(self, r: float, y: float, feedforward: float = 0.0) -> float: ...
    def set_design(self, other: Controller) -> None:
        """Adopt the other controller's settings without a bump; both need the same sample time."""

    def set_manual(self, u: float) -> None:
        """Make the command ``u`` from the next sample on, within the limits."""

    def set_automatic(self) -> None: ...
    @property
    def manual(self) -> bool: ...
    def reset(self) -> None: ...
    @property
    def filtered(self) -> float:
        """The feedback after its filter, at the last step."""

    def single(self) -> SingleController:
        """The same settings, rounded to single precision; at rest."""

    @property
    def numbers(self) -> dict[str, Any]:
        """The constants of the step: gains per sample, filters, limits; ``rows`` of the schedule have speed, Kp,
        Kp Ts/Ti, Td and one over the distance to the next."""

@final
class SingleStateFeedback:
    """State feedback in single precision."""

    def step(self, r: float, y: float, feedforward: float = 0.0) -> float: ...
    def reset(self) -> None: ...
    @property
    def filtered(self) -> float: ...
    @property
    def numbers(self) -> dict[str, Any]: ...

@final
class StateFeedback:
    """State feedback with an observer, one sample at a time; its gains follow from the weights."""

    def __new__(
        cls, *, num: Sequence[float], den: Sequence[float], rho: float, integral: float, noise: float, weight: float,
        lead: float, r_rate: float, u_min: float, u_max: float, slew: float, Ts: float,
    ) -> StateFeedback:
        """``num`` and ``den`` have four numbers each, without the leading 0 and 1."""

    def step(self, r: float, y: float, feedforward: float = 0.0) -> float: ...
    def reset(self) -> None: ...
    @property
    def filtered(self) -> float:
        """The observer's output at the last step."""

    def single(self) -> SingleStateFeedback:
        """The same gains, rounded to single precision; at rest."""

    def sent(self) -> list[float]:
        """The numbers sent to a device."""

    @property
    def numbers(self) -> dict[str, Any]:
        """The constants of the step: num, den, K, L, rest (the states at an output of 1), Kr, Ki, lead."""

_Controller: TypeAlias = Controller | StateFeedback

_Plant: TypeAlias = Machine | LinearModel | NeuralOE | NeuralSS

def closed_loop(
    plant: _Plant, controller: _Controller, reference: _F, *, counts_per_unit: float,
    encoder_phase: float = 0.5, feedforward: _F | None = None, disturbance: _F | None = None,
    noise: float = 0.0, seed: int = 0,
) -> dict[str, _F]:
    """Keys u, y (true output), feedback (after encoder and filter); all (N,). From rest, controller reset.

    ``feedforward`` is added to the command before its limits, ``disturbance`` behind them; both (N,) [u]. ``noise`` is
    the standard deviation of white noise that is measured with the output [y], drawn from ``seed``.

    ``counts_per_unit`` is counts per (output unit x second); 0 feeds the plant's output back unquantised.
    A virtual machine uses its own encoder. The controller passed in is not stepped. A loop that diverges
    is a FitError.
    """

def cost_terms(
    reference: _F, u: _F, y: _F, *, u_min: float, u_max: float, Ts: float,
) -> dict[str, float]:
    """tracking, chatter, effort, overshoot [%], rise [ms], lag [ms], saturation, u_max of a run."""

def run_cost(
    cost: Mapping[str, float], terms: Mapping[str, float], *, span: float, command: float,
) -> float:
    """The cost of a run with these terms, for references and commands of these ranges."""

_Lines: TypeAlias = tuple[_F, NDArray[np.complex128], _F, bool]  # rad/s, responses, radii; counted
_Variable: TypeAlias = tuple[str, tuple[float, float] | None]

class _Limits(TypedDict):
    """Ms of the linear plants, overshoot [%], |u|, recovery [ms], load [y]; a controller stands for its own figures on each plant."""

    Ms: float | None
    overshoot: float | None
    u: float | None
    recovery: float | _Controller | None
    load: float | _Controller | None

class _Task(TypedDict):
    """A tuning problem: controller, plants, references, cost and variables.

    Every plant is used in every variation (gain, extra delay in samples). Load steps are (reference, disturbance, band [y],
    samples of the mean). ``variables`` are (name, bounds or None); an empty list means the usual ones. Weights missing from ``cost``
    keep their defaults. ``linear_plants`` are (num, den) in powers of z^-1, ``measured`` ones
    (omega [rad/s], responses, radii of their circles, whether the output was counted). ``disturbances`` are commands behind the limits, one
    for each reference or none at all; ``noise`` is the standard deviation of white noise on each plant's measurement along them [y].
    """

    plants: Sequence[_Plant]
    references: Sequence[_F]
    disturbances: Sequence[_F]
    noise: Sequence[float]
    load_steps: Sequence[tuple[_F, _F, float, int]]
    start: _Controller
    counts_per_unit: float
    variations: Sequence[tuple[float, int]]
    variables: Sequence[_Variable]
    cost: Mapping[str, float]
    aggregate: str
    limits: _Limits
    linear_plants: Sequence[tuple[_F, _F]]
    measured: Sequence[_Lines]

def tune(
    task: _Task, *, method: str, evaluations: int, seed: int, threads: int, progress: _Progress = None
) -> dict[str, Any]:
    """Returns cost, violation, start_cost, variables (name, low, high), values, start (the values it began with), moved (whether
    the start lay outside bounds), trace, termination, weights.
    """

def tuning_costs(
    task: _Task, controllers: Sequence[_Controller], *, threads: int, progress: _Progress = None
) -> list[tuple[float, float, float, float]]:
    """Cost, violation, largest overshoot [%] and command [u] of each controller."""

def tuning_loads(task: _Task) -> list[tuple[float, float]]:
    """Recovery [ms] and rms deviation [y] of the start on each plant in each variation, the worst over the load steps."""

def pareto(
    task: _Task, *, others: Sequence[_Controller], objectives: Sequence[str], size: int, evaluations: int, seed: int, threads: int,
    progress: _Progress = None,
) -> dict[str, Any]:
    """Returns controllers (values of the variables), values (of the objectives), variables, evaluations, termination."""

# --- moves.rs ---------------------------------------------------------------------------------------------

def plan_move(
    plants: Sequence[Any], controller: _Controller, reference: _F, *, counted: bool, threads: int, progress: _Progress = None
) -> dict[str, Any]:
    """setpoint, y, u (means), errors (rms of each plant without and with), limited, interrupted."""

@final
class MoveLearner:
    """Improves the table of a move from the errors of its repetitions."""

    def __new__(
        cls, plants: Sequence[Any], controller: _Controller, reference: _F, table: _F, *, variations: Sequence[tuple[float, int]],
        counted: bool, threads: int, progress: _Progress = None,
    ) -> MoveLearner: ...
    @property
    def size(self) -> int:
        """Numbers of a correction."""
    @property
    def period(self) -> float:
        """Of a swing of which half passes the low-pass [samples]."""
    @property
    def contraction(self) -> float:
        """The largest ratio of a change of the correction to the one before, on plants and variations; below 1."""
    def signal(self, correction: _F) -> _F:
        """A correction as samples."""
    def next(self, correction: _F, error: _F, gain: float) -> tuple[_F, _F]:
        """The next correction after one with this error, and the error that it should leave."""

_Reach: TypeAlias = tuple[float, float, list[float], list[float], list[float], float]

def reach(
    plants: Sequence[Any], *, Ts: float, u: tuple[float, float], levels: tuple[float, float], share: float
) -> _Reach:
    """Least and largest level, levels, rates up and down at each, jerk: what all plants can do."""

def constant_reach(*, low: float, high: float, rate: float, jerk: float) -> _Reach:
    """The same bounds at every level."""

def profile(
    reference: _F, reach: _Reach, *, Ts: float, low: float, high: float, rate: float, jerk: float
) -> tuple[_F, list[bool]]:
    """The reference within a reach; whether levels, rate and jerk were at their bounds."""

# --- control/position.rs ----------------------------------------------------------------------------------

_Rates: TypeAlias = Sequence[tuple[float, float, float]]

@final
class PositionController:
    """A position loop over a PID with what it is to do, at rest; see ``sewfast_control::position``.

    ``rates``: speed, largest rates away from rest and towards it; ``stop``: samples before it, angle and turn
    [counts], whether it goes onward.
    """

    def __new__(
        cls, speed: Any, *, gain: float, counts_per_unit: float, fastest: float, rates: _Rates,
        smoothing: int, landing: float, creep: float, releases: bool,
        stop: tuple[int, float, float, bool] | None = None,
    ) -> PositionController: ...
    def step(self, r: float, y: float) -> float:
        """The command, from a goal [counts] or, before a stop, a speed, both early, and the counted speed."""
    def reset(self) -> None: ...
    @property
    def filtered(self) -> float: ...
    @property
    def place(self) -> float:
        """Where the profile is at this sample [counts]."""
    @property
    def goal(self) -> float: ...
    def early(self, reference: _F) -> _F:
        """References as the steps take them; the last value stays."""
    def single(self, early: _F, counts: _F) -> list[_F]:
        """Commands, places and goals [counts] of a device, which computes in single precision, from early references and the
        counts that it had: NaN before a stop, and from missing counts on."""

def position_run(
    plant: Any, controller: PositionController, reference: _F, *, counts_per_unit: float,
    encoder_phase: float = 0.5, disturbance: _F | None = None,
) -> dict[str, _F]:
    """u, y, feedback, counts, position, place, goal of a run from rest on a model or a virtual machine."""

def position_rates(reach: _Reach) -> tuple[list[tuple[float, float, float]], float]:
    """Rows of rates from rest on that a reach has in either direction, and the largest speed that it knows."""

def approach(rates: _Rates, speed: float, *, hold: int, Ts: float) -> _F:
    """A reference that comes up to a speed at the rates and holds it for so many samples."""

def judge_stops(
    plants: Sequence[Any], speed: Any, designs: Sequence[tuple[float, _Rates, int, float, float]], *,
    counts_per_unit: float, fastest: float, turn: float, speeds: Sequence[float], before: int,
    after: int, load: float, variations: Sequence[tuple[float, int]], encoder_phase: float = 0.5,
    progress: _Progress = None,
) -> list[list[float]]:
    """Of each design (gain, rates, smoothing, landing, creep) the worst of all plants: rms error, how far a stop
    passes its angle, how far from it the shaft rests, its swing there, and how far it yields to a load [counts]."""

# --- rules.rs ---------------------------------------------------------------------------------------------

def fit_fopdt(u: _F, y: _F, *, Ts: float) -> dict[str, Any]:
    """K, T [s], L [s], offset, u_low, u_high, fit_percent, from a step response (paper Eq. 10-11).

    K_se, T_se, L_se: standard errors; limited: samples on a limit of the output; moving: whether it did not start at rest.
    """

def table_1(K: float, T: float, L: float, *, nearest: bool = False) -> dict[str, float]:
    """Kp, Ti, Td, alpha, beta by the paper's Table 1, interpolated; L/T outside .1 to 1 is an error.

    ``nearest`` takes the end row there instead.
    """

def eq_12(K: float, T: float, L: float, *, Ms: float) -> dict[str, float]:
    """Kp, Ti, Td, alpha, beta of the least Eq. 12 with max |S| of at most Ms; disturbance_cost, reference_cost, Ms."""

def eq_12_costs(
    ratio: float, *, KpK: float, Ti: float, Td: float, alpha: float, beta: float,
) -> dict[str, float]:
    """disturbance_cost, reference_cost, Ms of gains for L/T = ratio with K = T = 1."""

def simc(K: float, T: float, L: float, *, tau_c: float, derivative: bool) -> dict[str, float]:
    """Kp, Ti, Td, alpha, beta (Skogestad 2003; the derivative by L/3)."""

def amigo(K: float, T: float, L: float) -> dict[str, float]:
    """Kp, Ti, Td, alpha, beta (Astrom and Hagglund 2004)."""

# --- loop_transfer.rs -------------------------------------------------------------------------------------

@final
class LoopPath:
    """The parts of a controller within the loop: gains in standard form, derivative filter, feedback filters.

    ``encoder``: the output is measured as a mean over the previous sample. ``slope`` [u/y] is added to the
    proportional gain: the effect of a gain schedule on ``-Kp alpha r``. ``position`` is the gain of a position
    loop around it [1/s].
    """

    def __new__(
        cls, *, Kp: float, Ti: float, Td: float, N: float, Ts: float, filter_samples: int,
        filter_time: float, observer_time: float, encoder: bool, slope: float = 0.0,
        biquads: Sequence[tuple[float, float, float, float]] = ..., position: float = 0.0,
    ) -> LoopPath: ...

def sampled_fopdt(K: float, T: float, L: float, *, Ts: float) -> tuple[_F, _F]:
    """num, den in powers of z^-1 of K e^(-sL)/(1 + sT) under a zero-order hold; L may be any fraction of Ts."""

def loop_response(path: LoopPath, num: _F, den: _F, omega: _F) -> NDArray[np.complex128]:
    """L, broken at the plant's input, at omega [rad/s]; the plant in powers of z^-1."""

def margins(path: LoopPath, num: _F, den: _F) -> dict[str, Any]:
    """stable, largest_pole, Ms, Ms_omega, Mt, Mt_omega, gain_margin, gain_reduction, phase_margin_deg,
    delay_margin_s, noise_gain, bandwidth, gain_crossovers, phase_crossovers; omegas, bandwidth and
    crossovers in rad/s.

    An unstable loop has infinite peaks and noise gain, its other margins are NaN.
    """

def position_sensitivity(path: LoopPath, num: _F, den: _F) -> float:
    """Largest sensitivity of the position loop of a path, broken at its error; inf for an unstable loop."""

def tolerance(
    path: LoopPath, num: _F, den: _F
) -> tuple[float, tuple[float, float, int, float] | None]:
    """Ms as a limit of it is compared, and what a resonance adds to it; None without one.

    That is the largest Ms with -20 to +25 % of gain, 0 or 2 samples of delay and 10 % of the
    resonance's frequency, then the factor on the gain, the delay [samples] and the factor on the
    frequency with which it is. The first is Ms, or half of that.
    """

@final
class ProposalTask:
    """The search for gains and filters of the largest bandwidth; ``path`` has what is not searched.

    ``above``: the fit above the measured ``lines``; ``quiet``: largest noise gain, inf for none.
    """

    def __new__(
        cls, path: LoopPath, num: _F, den: _F, *, lines: _Lines, above: _Lines, Ms: float, quiet: float
    ) -> ProposalTask: ...

    def best(
        self, starts: Sequence[_F]
    ) -> tuple[float | None, _F, tuple[tuple[float, float, float, float], float, list[list[float]]]]:
        """Merit, None if not stable within Ms; the logarithms; Kp, Ti, Td, N; the lag [s]; each filter.

        A start has the logarithms of Kp, Ti, Td, the lag, and of a notch's frequency, depth and width
        or of frequency and damping of one or two biquads' zeros, then of their poles.
        """

def shaft_response(theta: _F, hertz: _F, *, Ts: float, counted: bool) -> NDArray[np.complex128]:
    """Response of a machine with shafts under a held command: speed at the samples, or its mean between them.

    ``theta``: logarithms of K, a1, a2, the delay [samples], then of w_r, z_r, w_a, z_a of each shaft.
    """

def record_response(
    u: _F, y: _F, r: _F | None
) -> tuple[_F, NDArray[np.complex128], _F, _F, _F, bool] | None:
    """Response by local polynomials: lines, values, variances, coherences, averaged values, whether r moves u."""

def shaft_fraction(theta: _F, *, Ts: float) -> tuple[_F, _F]:
    """num, den in powers of z^-1 of the same machine's speed at the samples."""

def changed(experiments: Sequence[tuple[_F, _F]]) -> tuple[int, int, float, int, float] | None:
    """Experiment and sample from which on a record has another sign, scale or time; gain, shift, error left."""

def copied(experiments: _Experiments) -> tuple[int, float, float, int] | None:
    """Input, gain, offset and delay if the output repeats an input to rounding."""

def computed(experiments: _Experiments) -> str | None:
    """Whether the "output" or its "change" is a sum of inputs in the same sample and some before, or a "curve" of them."""

def order_in_time(experiments: _Experiments) -> tuple[str, int, int, float] | None:
    """Kind, input, shift and twice the log-likelihood of an input that moves after the output."""

def integration(
    experiments: _Experiments, *, Ts: float
) -> tuple[bool, int, float, float, float, float, float] | None:
    """Whether the output integrates, input, lengths, time constant, gain, standard errors of restoring and driving."""

def feedback(experiments: _Experiments) -> tuple[int, int, float, float, float] | None:
    """Input, lead, correlation, significance and misfit of the clearest answer to the output's noise."""

def quantum(column: _F) -> float | None:
    """The step of a grid on which all values lie."""

def dead(experiments: _Experiments) -> list[list[tuple[int, int]]]:
    """First sample and length of each experiment's stretches in which the output's sensor was dead."""

def spikes(experiments: _Experiments) -> list[list[tuple[int, int]]]:
    """The same of a few samples that have most of the output's power."""

def two_levels(experiments: _Experiments) -> list[tuple[float, float] | None]:
    """The two levels of every input that has no others."""

def limits(experiments: _Experiments) -> list[tuple[int, float, int, float]]:
    """Input, limit, stretches and share of the samples at each limit at which an input stays."""

def rests(experiments: _Experiments) -> list[tuple[int, int]]:
    """Samples at rest at the beginning and the end of every experiment."""

def period(experiments: _Experiments) -> tuple[float, float] | None:
    """Period in samples of the longest experiment, if its inputs repeat, and their correlation."""

def wraps(experiments: _Experiments) -> tuple[float, int] | None:
    """A turn and the number of jumps of an output that wraps."""

def unstable_pole(experiments: _Experiments) -> float | None:
    """Modulus per sample of a pole outside the unit circle."""

_Delay = tuple[int, tuple[int, int], int | None, _F, _F, _F, float]
"""Lag of the least cost, plausible lags, first correlated lag, costs in free run and one step ahead, correlations, bound."""

def delay(
    experiments: _Experiments, *, least: int, longest: int, confidence: float
) -> list[_Delay]:
    """The delay of every input; lags count from `least`."""

_Structure = tuple[tuple[int, int, int], int, float, _F, list[float], float]
"""na, nb, nk; parameters; one-step error; squared free-run errors in parts; AIC, AICc, BIC, FPE; Lipschitz index."""

def order_table(
    train: _Experiments, later: _Experiments, *, na: Sequence[int], nb: Sequence[int],
    nk: Sequence[int], init: int, progress: _Progress = None,
) -> list[_Structure]:
    """Errors of linear models on later data, after `init` outputs for the initial state."""

_Experiment = tuple[_F, _F, _F, NDArray[np.bool_], _F]
"""Inputs, computed output, residual, which samples count, sensitivities."""
_Tested = tuple[list[int], list[list[int]], _F, _F, float, float, int, float, float]
"""Lags, series, correlations, limits, statistic, p-value, degrees of freedom, threshold, explained share."""

def explained(x: _F, y: _F, *, own: int, parts: int) -> list[float]:
    """Share of what the first `own` columns of x (N, n) leave of y (N,) that all explain, a part."""

def residual_tests(experiments: list[_Experiment], *, memory: int, one_step: bool) -> list[_Tested]:
    """Tests of residuals, in the order of `sewfast.evidence.residual_tests`. A series is a product of inputs."""

def parameter_test(experiments: list[_Experiment], *, trained: int) -> _Tested:
    """Whether other parameters would do better; the sensitivities' significant directions are its lags."""

def coloured_information(experiments: list[_Experiment], *, spent: float) -> _F:
    """Psi'R Psi, R the covariance matrix of the residuals, of which parameters took ``spent`` degrees of freedom."""

def innovation(series: list[_F]) -> float:
    """Standard deviation of what the past of the series does not tell, pooled; NaN is not known."""

def fit_shaft(
    hertz: _F, value: NDArray[np.complex128], sigma: _F, *, Ts: float, counted: bool,
    resonance: bool | None,
) -> tuple[float, _F, _F, float | None]:
    """Sum of squares, theta, covariance, and the frequency of a resonance above the lines [Hz].

    ``sigma``: standard deviation of real and imaginary part. ``resonance``: whether there is a shaft; None: if it
    explains clearly more. The sum of squares is infinite if nothing converges.
    """

def effort(u: _F, *, u_min: float, u_max: float) -> dict[str, float]:
    """u_rms, du_rms (change from sample to sample), saturated (share of samples at a limit)."""

def step_metrics(y: _F, reference: _F, *, Ts: float, smoothing: float) -> dict[str, float]:
    """rise_time_ms, reference_rise_time_ms, overshoot_percent of a response to a step or trapezoid."""

# --- link.rs: see docs/PROTOCOL.md ------------------------------------------------------------------------

def link_frame(kind: int, tag: int, sequence: int, time: int, body: bytes) -> bytes:
    """A frame as sent, with its closing zero; a body of more than 231 bytes raises a SettingError."""

@final
class LinkBodies:
    """The bodies of a host's frames, and of a device's replies (docs/PROTOCOL.md).

    Numbers beyond single precision become infinite. A body of more than 231 bytes raises a SettingError.
    Functions that read a reply return None if it is too short or of another kind.
    """

    VERSION: int
    MAX_BODY: int
    AROUND: int
    @staticmethod
    def host_time(session: int, us: int) -> int: ...
    @staticmethod
    def hello(session: int) -> bytes: ...
    @staticmethod
    def arm(watchdog: int, key: int) -> bytes: ...
    @staticmethod
    def keep(watchdog: int) -> bytes: ...
    @staticmethod
    def drive(watchdog: int, u: float) -> bytes: ...
    @staticmethod
    def credit(watchdog: int, until: int) -> bytes: ...
    @staticmethod
    def limits(values: Sequence[float]) -> bytes:
        """Volt, speed, acceleration, current; zeros query the present ones."""
    @staticmethod
    def upload(table: int, offset: int, values: bytes) -> bytes: ...
    @staticmethod
    def gains(
        values: Sequence[float],
        filter_samples: int,
        design: tuple[float, float, Sequence[Sequence[float]]] | None = None,
    ) -> bytes:
        """Twelve numbers and the filter's samples; the design is observer time, r rate, schedule."""
    @staticmethod
    def feedforward(
        preview: int, late: float, levels: Sequence[tuple[float, float]], taps: Sequence[float]
    ) -> bytes:
        """Levels of output and command."""
    @staticmethod
    def position(
        numbers: Sequence[float], smoothing: int, releases: bool,
        rows: Sequence[tuple[float, float, float]],
    ) -> bytes:
        """Gain, fastest, landing and creep; samples of smoothing; rows of speed and rates away from and towards rest."""
    @staticmethod
    def angle(at: int, counts: float, onward: bool) -> bytes:
        """A stop at an angle [counts] from a sample of the run on, 0 for its next one."""
    @staticmethod
    def travel(low: int, high: int) -> bytes:
        """Least and greatest count; both 0 ask only."""
    @staticmethod
    def biquads(sections: Sequence[Sequence[float]]) -> bytes:
        """Sections of c0, c1, a1, a2."""
    @staticmethod
    def controller(kind: int, counts_per_unit: float, values: Sequence[float]) -> bytes:
        """The number of a kind, counts per unit and second, the numbers of the kind."""
    @staticmethod
    def start(mode: int, watchdog: int, at: int, length: int, mask: int, batch: int) -> bytes: ...
    @staticmethod
    def reply(body: bytes) -> tuple[int, int, bytes] | None:
        """Sequence, result, and the rest of the body."""
    @staticmethod
    def detail(rest: bytes) -> int | None:
        """Detail of a refusal."""
    @staticmethod
    def greeting(
        body: bytes,
    ) -> tuple[tuple[str, str, int, int, int, int, int, int, int, int, float], int, int] | None:
        """Name, firmware, version, boot, schema, state, channels, period, capabilities, capacity, counts; session; key."""
    @staticmethod
    def description(body: bytes) -> tuple[int, int, int, str, str] | None:
        """Number, encoding, steps per unit, name, unit of a channel."""
    @staticmethod
    def schema(version: int, period_us: int, replies: Sequence[bytes]) -> int:
        """CRC-32 of version, period and the replies to all DESCRIBE."""
    @staticmethod
    def status(
        body: bytes,
    ) -> (
        tuple[
            tuple[int, int, int, int, int, int, int, int, int],
            tuple[float, int, int, int, int, int, int, int],
        ]
        | None
    ):
        """State, reason, mode, mask, run, start, taken, length, end; speed, counts, received, refused, dropped, late, session, foreign."""
    @staticmethod
    def limits_of(
        body: bytes,
    ) -> list[float] | None:
        """Volt, speed, acceleration, current in force, then their ceilings."""
    @staticmethod
    def travel_of(body: bytes) -> list[int] | None:
        """Least and greatest count in force, then the device's own."""
    @staticmethod
    def started(body: bytes) -> tuple[int, int] | None: ...
    @staticmethod
    def uploaded(body: bytes) -> tuple[int, int] | None: ...
    @staticmethod
    def event(body: bytes) -> tuple[int, int, int, int, int, float] | None:
        """Code, state, reason, run, samples, value."""

_Anomaly: TypeAlias = Literal[
    "missing", "repeated", "late", "reset", "rejected", "echoed", "malformed", "untaken"
]

@final
class LinkClient:
    """A session with a device as bytes and times: it has neither port nor clock (docs/PROTOCOL.md).

    Times of the host are in microseconds of a monotonic clock. Feed it received bytes, ask it for expired commands, and write
    what it transmits, by ``due`` at the latest. Samples, counters and anomalies are those of ``LinkReceiver``.
    """

    def __new__(cls, session: int) -> LinkClient: ...
    def set_watchdog(self, us: int) -> None:
        """Time for which the device continues without a heartbeat; STOP is repeated for at least as long."""
    def receive(
        self, now_us: int, data: bytes
    ) -> tuple[list[tuple[int, int, int, bytes, int, int]], list[tuple[int, int, int, int, int, float, int]], bool]:
        """Replies (kind, result, detail, body, device's time, when the command was sent first), events (code, state, reason,
        run, samples, value, device's time), and whether all that came is of the boot that was greeted."""
    def greet(self, patience_us: int) -> None:
        """Starts sending HELLO, before anything else, for this time."""
    def end_greeting(self) -> None: ...
    def begin(self, kind: int, body: bytes) -> None:
        """Starts sending a command; SettingError for a body of more than 231 bytes."""
    def forget(self) -> None:
        """Ends the pending command."""
    def expire(self, now_us: int) -> tuple[int, int, int, int] | None:
        """Kind, attempts, microseconds waited and other received frames, for a command without a reply."""
    def transmit(self, now_us: int) -> bytes:
        """The pending frame, if it is new or due for repetition; empty otherwise."""
    def keep(self, now_us: int) -> bytes:
        """A heartbeat."""
    def drive(self, now_us: int, u: float) -> bytes:
        """The command of a direct run [V]; also a heartbeat."""
    def grant(self, now_us: int, until_us: int) -> bytes:
        """Lets the time of a device on credit advance to this value; also a heartbeat."""
    def go_on(self, command: int, heartbeat: int) -> None:
        """Continues after these numbers, reached by another client; frames received meanwhile are not missing."""
    @property
    def is_busy(self) -> bool: ...
    @property
    def due(self) -> int | None:
        """Latest time for calling ``transmit`` or ``expire``; None if nothing is pending."""
    @property
    def newest(self) -> int:
        """Largest time in any of the device's frames [us]."""
    @property
    def heard(self) -> int | None:
        """Time of its last received frame."""
    @property
    def sequences(self) -> tuple[int, int]:
        """Numbers of the last command and of the last heartbeat."""
    def expect(self, channels: Sequence[tuple[int, int]], period_us: int) -> None: ...
    def take(self) -> tuple[NDArray[np.int64], list[_F]]: ...
    @property
    def counters(self) -> dict[str, int]: ...
    def anomalies(self) -> list[tuple[_Anomaly, int, int]]: ...

@final
class LinkReceiver:
    """Receives what a device sends. Damaged, repeated and late frames are counted, listed and not used.

    At most 131,072 samples and 16,384 anomalies are kept until the caller takes them.
    """

    def __new__(cls) -> LinkReceiver: ...
    def expect(self, channels: Sequence[tuple[int, int]], period_us: int) -> None:
        """Encoding and steps per unit of the channels streamed from now on; drops samples not taken."""
    def feed(self, data: bytes) -> list[tuple[int, int, int, int, bytes]]:
        """Whole frames in order, as kind, tag, sequence, time [us], body.

        Samples are not among them, except before ``expect``.
        """
    def take(self) -> tuple[NDArray[np.int64], list[_F]]:
        """Device times [us] (N,) and one column per channel (N,), in its unit, since the last call.

        Counts continue beyond 32 bits; they restart after a reset of the device.
        """
    @property
    def counters(self) -> dict[str, int]:
        """frames, samples, rejected, missing, repeated, late, resets, echoed, malformed, untaken, clipped, overflows, unlisted.

        Frames that came late are among the missing. ``clipped`` and ``overflows`` count batches whose flags say so;
        ``unlisted`` are entries for which ``anomalies`` had no room.
        """
    def anomalies(self) -> list[tuple[_Anomaly, int, int]]:
        """Kind, frame number and count of what went wrong since the last call, oldest first.

        missing: the first of ``count`` frames. reset: the first frame of the boot that came, and how many before it
        did not. rejected: the number expected then. untaken: ``count`` samples found no room.
        """

@final
class LinkUpload:
    """A run's values as the device stores them, uploaded ahead of it piece by piece."""

    @staticmethod
    def commands(values: _F, steps_per_unit: int, limit: float) -> LinkUpload:
        """Rounded to steps of the device's command channel, then limited to ``limit``."""
    @staticmethod
    def references(values: _F, limit: float) -> LinkUpload:
        """In single precision, limited to ``limit``."""
    @staticmethod
    def goals(values: _F) -> LinkUpload:
        """In single precision [counts]."""
    @property
    def end(self) -> int:
        """Number of values on the device."""
    @property
    def is_whole(self) -> bool: ...
    def piece(self, room: int) -> bytes | None:
        """Body of the next UPLOAD, if there is room for a full frame or the rest."""
    def answered(self, result: int, detail: int, body: bytes) -> bool:
        """Processes the reply to an UPLOAD: its end, or the device's next position. False if it refuses the values."""

# --- host_loop.rs -----------------------------------------------------------------------------------------

def host_loop(
    port: int, controller: Controller, reference: _F, *, tag: int, session: int, key: int, command: int, heartbeat: int,
    device_period: int, ratio: int, watchdog: int, batch: int, mask: int, channels: Sequence[tuple[int, int]], counts_per_unit: float,
    lock_memory: bool = False, progress: _Progress = None,
) -> dict[str, Any]:
    """Drive a device in mode 2 from the open descriptor ``port``; every time is in microseconds.

    ``command`` and ``heartbeat`` are the sequences last used in the session; ``channels`` are encoding and steps per unit
    of the channels in ``mask``. Keys: outcome (name; reason, value, command, result, detail, text where they apply),
    ticks (number, late, age, fresh, y, feedback, u; all (n,)), missed, unsent, times (int64) and columns of the samples,
    start, round_trip, stopped, taken and device_late (None where the device did not say), counters, sequences, memory
    (None: not asked for; empty: locked; else the refusal). Ctrl-C is an outcome, not an exception.
    """

# --- guard.rs ---------------------------------------------------------------------------------------------

def causes(
    u: _F, counts: _F, before: Sequence[tuple[_F, _F]], *, Ts: float, counts_per_rev: float, most: float = ...
) -> dict[str, Any]:
    """What has changed in a machine, from a run (u, counts) and earlier ones, all from rest; ``most`` is its largest command [u].

    ``motor`` (gain [RPM/u], lag and delay [s], friction and bias [u]) is fitted to the earlier runs or, without any, to this
    one; ``unsure`` is its rms error on the earlier runs over their rms speed, ``together`` what this run adds to their
    errors if one motor is fitted to all, as an rms over the run [RPM], both NaN without earlier ones; ``backwards`` is the
    relative error of a motor that turns against its command, on this run; ``error`` is the rms error of its speed on this
    one, ``size`` the rms speed, ``rounding`` the part of a count [RPM]. ``findings`` are changes, the best first, each with
    its value, its time [s], the error with it [RPM] and the motor until then.
    """

@final
class Guard:
    """The device's guard for a run on a machine without one: speed [RPM], a motor that stands under a large command of up to
    ``volt``, and a command that swings between the limits ``between`` of a loop. What it sees is a reason (Speed, NoMotion,
    Swinging) with the value that passed its limit [RPM, V, Hz].
    """

    def __new__(
        cls, *, Ts: float, counts_per_rev: float, volt: float, speed: float, between: tuple[float, float] | None = None
    ) -> Guard: ...
    def take(self, counts: float) -> tuple[str, float] | None:
        """Takes the counts of a sample, before its command acts."""

    def sent(self, u: float) -> tuple[str, float] | None:
        """Takes the command of that sample."""

    def watch(self, u: _F, counts: _F) -> tuple[int, tuple[str, float]] | None:
        """Takes the counts and commands of samples, both (N,); with the place of the sample at which something was seen."""

    @property
    def at_rest(self) -> bool:
        """No count for a tenth of a second."""

# --- device.rs --------------------------------------------------------------------------------------------

@final
class DeviceServer:
    """The virtual device on a thread of its own; `sewfast.link.VirtualDevice` checks the arguments."""

    def __new__(
        cls, machine: Machine, *, name: str, pty: bool, link: Path | None, address: str, anyone: bool,
        fast: bool,
        baud: int | None, faults: str, seed: int, once: bool, duration: float | None, fault_log: Path | None,
        trace: Path | None,
    ) -> DeviceServer:
        """Opens the port; raises LinkError if that fails. ``link`` is for a pty, ``address`` for TCP;
        ``anyone`` allows an address that other computers can reach."""
    @property
    def port(self) -> str: ...
    def wait(self, timeout: float) -> bool:
        """Whether serving has ended, after at most ``timeout`` seconds."""
    def stop(self) -> None: ...
    def cause(self, fault: str, seconds: float | None = None) -> None: ...
    def faults(self) -> dict[str, dict[str, int]]:
        """By ``to_host`` and ``to_device``, then by kind."""
    def statistics(self) -> dict[str, int]: ...
    def trace(self) -> list[dict[str, Any]]: ...
    def problem(self) -> str | None: ...
