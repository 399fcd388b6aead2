//! Controllers in lanes, one in each; the same code with one number in place of eight runs a single controller.

use sewfast_control::{
    AnyController, BIQUADS, Biquad, Controller, Numbers, PidController, STATES, StateDesign,
    StateFeedback,
};

use crate::simd::{Arithmetic, LANES};

/// A kind of controller that runs in lanes.
pub(crate) trait InLanes: Controller<f64> {
    /// Eight of them, or one.
    type Lanes<V: Arithmetic>: LaneController<V>;

    /// Whether this one can share lanes with `first`.
    fn fits(&self, first: &Self) -> bool;

    /// The first eight of `controllers`, at rest; missing ones repeat the first.
    fn in_lanes<V: Arithmetic>(controllers: &[&Self]) -> Self::Lanes<V>;
}

/// What a loop asks of the controllers in its lanes, in two parts so that other work can run between them.
pub(crate) trait LaneController<V> {
    /// Takes measured outputs.
    // Split for `Decision`: filters run while the plants of another group step.
    fn take(&mut self, first: bool, measured: V);
    /// From the reference and the measurement to the commands.
    fn decide(&mut self, first: bool, r: f64, feedforward: Option<f64>) -> V;
    /// The feedback after its filter, at the last sample.
    fn filtered(&self) -> V;
}

/// Work on controllers of one kind, generic over the kind.
pub(crate) trait WithKind {
    /// The result.
    type Output;

    /// Does the work.
    fn with<C: InLanes>(self, controllers: &[&C]) -> Self::Output;
}

/// Does `work` with controllers that are all of one kind and fit in lanes; `None` for others.
pub(crate) fn of_a_kind<W: WithKind>(
    controllers: &[&AnyController<f64>],
    work: W,
) -> Option<W::Output> {
    match controllers.first()? {
        AnyController::Pid(_) => all(controllers, AnyController::pid).map(|all| work.with(&all)),
        AnyController::StateFeedback(_) => {
            all(controllers, AnyController::state_feedback).map(|all| work.with(&all))
        }
    }
}

/// Whether controllers are all of one kind and fit in lanes.
pub(crate) fn are_of_a_kind(controllers: &[&AnyController<f64>]) -> bool {
    struct Nothing;
    impl WithKind for Nothing {
        type Output = ();

        fn with<C: InLanes>(self, _controllers: &[&C]) {}
    }
    of_a_kind(controllers, Nothing).is_some()
}

/// The controllers as type `C`, if each of them is one and fits in lanes.
fn all<'a, C: InLanes>(
    controllers: &[&'a AnyController<f64>],
    within: impl Fn(&'a AnyController<f64>) -> Option<&'a C>,
) -> Option<Vec<&'a C>> {
    let first = within(controllers.first()?)?;
    let fitting = |c: &&'a AnyController<f64>| within(c).filter(|c| c.fits(first));
    // `Option<Vec>`: a single one that does not fit sends all of them to the scalar loop, which gives the same bits.
    controllers.iter().map(fitting).collect()
}

impl InLanes for PidController<f64> {
    type Lanes<V: Arithmetic> = Controllers<V>;

    fn fits(&self, first: &Self) -> bool {
        let sections = |c: &Self| c.design().biquads.sections().len();
        // of a feedforward the loop knows nothing: see `Lead`
        self.numbers().is_some()
            && self.design().feedforward.is_none()
            && sections(self) == sections(first)
    }

    #[inline(always)]
    fn in_lanes<V: Arithmetic>(controllers: &[&Self]) -> Controllers<V> {
        Controllers::new(controllers)
    }
}

/// A derivative term below this is set to 0: in a loop at rest it would decay for ever through subnormal numbers, for
/// which processors take a hundred times as long.
// Found as a loop at rest that ran three times slower. The dropped value is below every digit of a command.
const FADED: f64 = 1e-280;

/// Eight cascades of equally many biquads, with their states for feedback and reference.
struct Cascades<V> {
    count: usize,
    /// `c0`, `c1`, `a1` and `-a2` of each section.
    sections: [[V; 4]; BIQUADS],
    of_y: [[V; 3]; BIQUADS],
    of_r: [[V; 3]; BIQUADS],
}

impl<V: Arithmetic> Cascades<V> {
    /// Those of the first eight controllers; missing ones repeat the first.
    #[inline(always)]
    fn new(controllers: &[&PidController<f64>]) -> Self {
        let of = |i: usize| controllers.get(i).unwrap_or(&controllers[0]).design();
        let number = |k: usize, of_section: &dyn Fn(&Biquad<f64>) -> f64| {
            V::load(&std::array::from_fn(|i| {
                of(i).biquads.sections().get(k).map_or(0.0, of_section)
            }))
        };
        let rest = [[V::splat(0.0); 3]; BIQUADS];
        Self {
            count: of(0).biquads.sections().len(),
            sections: std::array::from_fn(|k| {
                [
                    number(k, &|s| s.c0),
                    number(k, &|s| s.c1),
                    number(k, &|s| s.a1),
                    number(k, &|s| -s.a2),
                ]
            }),
            of_y: rest,
            of_r: rest,
        }
    }

    /// The next sample of the feedback; on the first sample the filters are at rest there.
    #[inline(always)]
    fn feedback(&mut self, first: bool, y: V) -> V {
        let sections = &self.sections[..self.count];
        Self::step(sections, &mut self.of_y, first.then_some(y), y)
    }

    /// The next sample of the reference; on the first sample the filters are at rest at the output `y`.
    #[inline(always)]
    fn reference(&mut self, first: bool, y: V, r: V) -> V {
        let sections = &self.sections[..self.count];
        Self::step(sections, &mut self.of_r, first.then_some(y), r)
    }

    /// The next sample of a signal; `before` is the value at which it was at rest, given with the first sample.
    #[inline(always)]
    fn step(sections: &[[V; 4]], memory: &mut [[V; 3]; BIQUADS], before: Option<V>, x: V) -> V {
        let mut x = x;
        for (&[c0, c1, a1, a2], state) in sections.iter().zip(memory) {
            if let Some(level) = before {
                *state = [level, V::splat(0.0), V::splat(0.0)];
            }
            // `Memory::step` of the crate `sewfast_control`; -(a2 d) and (-a2) d have the same bits
            let [last, s1, s2] = *state;
            let change = x.sub(last);
            let d = c0.mul(change).add(s1);
            *state = [x, c1.mul(change).sub(a1.mul(d)).add(s2), a2.mul(d)];
            x = x.add(d);
        }
        x
    }
}

/// Eight [`PidController`]s with constant gains: the same operations in the same order.
pub(crate) struct Controllers<V> {
    average: Averages<V>,
    lag: V,
    /// `1 - a`, `b`, and 1 if there is an observer; `None` if no lane has one.
    // `None` in these three is a branch that goes the same way at every sample: a stage that no lane has is not computed. If only some
    // lanes have it, the others compute it with neutral numbers (no ramp: an infinite change), or select.
    observer: Option<[V; 3]>,
    /// Largest change of the reference in one sample; `None` if no lane has a ramp.
    ramp: Option<V>,
    // Boxed: indexed arrays would keep the whole struct out of registers, even without biquads (5 % more instructions
    // then).
    biquads: Option<Box<Cascades<V>>>,
    kp: V,
    ki: V,
    kd: V,
    pole: V,
    alpha: V,
    beta: V,
    tracking: V,
    /// 1 in lanes with conditional integration.
    conditional: V,
    low: V,
    high: V,
    /// Largest change of the command in one sample; `None` if no lane has a limit.
    change: Option<V>,
    lagged: V,
    observed: V,
    innovation: V,
    r: V,
    /// The derivative's input at the last sample; NaN before the first.
    // This stores `e - beta r`; the scalar law stores e and r and forms it again. Same operations, same bits, one value
    // less to hold.
    input: V,
    derivative: V,
    integral: V,
    u: V,
    /// The feedback after its filter, at the last step.
    pub filtered: V,
}

impl<V: Arithmetic> Controllers<V> {
    /// The first eight of `controllers`, at rest; missing ones repeat the first.
    #[inline(always)]
    pub fn new(controllers: &[&PidController<f64>]) -> Self {
        let lane = |i: usize| *controllers.get(i).unwrap_or(&controllers[0]);
        let number = |i: usize| lane(i).numbers();
        // `dyn`, not generic: this runs once per candidate, and a copy for each of the sixteen settings would be most
        // of the code.
        let each = |of: &dyn Fn(Numbers<f64>) -> f64| {
            V::load(&std::array::from_fn(|i| number(i).map_or(f64::NAN, of)))
        };
        let setting = |of: &dyn Fn(&PidController<f64>) -> f64| {
            V::load(&std::array::from_fn::<_, LANES, _>(|i| of(lane(i))))
        };
        let any = |of: &dyn Fn(&PidController<f64>) -> bool| (0..LANES).any(|i| of(lane(i)));
        let observer = [
            each(&|n| n.observer.map_or(0.0, |(keep, _)| keep)),
            each(&|n| n.observer.map_or(0.0, |(_, gain)| gain)),
            each(&|n| f64::from(u8::from(n.observer.is_some()))),
        ];
        let (zero, nan) = (V::splat(0.0), V::splat(f64::NAN));
        let (low, high) = (
            setting(&|c| c.settings().u_min),
            setting(&|c| c.settings().u_max),
        );
        Self {
            average: Averages::new(std::array::from_fn(|i| number(i).map_or(1, |n| n.samples))),
            lag: each(&|n| n.lag),
            observer: any(&|c| c.design().observer_time > 0.0).then_some(observer),
            ramp: any(&|c| c.design().r_rate < f64::INFINITY).then_some(each(&|n| n.ramp)),
            biquads: any(&|c| !c.design().biquads.is_empty())
                .then(|| Box::new(Cascades::new(controllers))),
            kp: each(&|n| n.terms.kp),
            ki: each(&|n| n.terms.ki),
            kd: each(&|n| n.terms.kd),
            pole: each(&|n| n.terms.pole),
            alpha: setting(&|c| c.settings().alpha),
            beta: setting(&|c| c.settings().beta),
            tracking: each(&|n| n.tracking),
            conditional: setting(&|c| f64::from(u8::from(c.settings().tt == 0.0))),
            low,
            high,
            change: any(&|c| c.settings().slew < f64::INFINITY)
                .then_some(setting(&|c| c.settings().slew * c.settings().ts)),
            lagged: zero,
            observed: zero,
            innovation: zero,
            r: zero,
            input: nan,
            derivative: zero,
            integral: zero,
            // As `Pid::reset`: the slew limit starts from 0 or from the limit nearest to it.
            u: zero.at_least_each(low).at_most_each(high),
            filtered: zero,
        }
    }
}

impl<V: Arithmetic> LaneController<V> for Controllers<V> {
    #[inline(always)]
    fn take(&mut self, first: bool, measured: V) {
        self.filtered = self.filter(first, measured);
        if let Some(biquads) = &mut self.biquads {
            self.filtered = biquads.feedback(first, self.filtered);
        }
    }

    #[inline(always)]
    fn decide(&mut self, first: bool, r: f64, feedforward: Option<f64>) -> V {
        let mut r = self.reference(first, r);
        if let Some(biquads) = &mut self.biquads {
            r = biquads.reference(first, self.filtered, r);
        }
        self.control(r, self.filtered, feedforward)
    }

    #[inline(always)]
    fn filtered(&self) -> V {
        self.filtered
    }
}

impl<V: Arithmetic> Controllers<V> {
    #[inline(always)]
    fn filter(&mut self, first: bool, x: V) -> V {
        let x = self.average.step(first, x);
        // `first` is one flag, as all lanes begin at the same sample: a branch instead of a selection.
        let from = if first { x } else { self.lagged };
        self.lagged = from.add(self.lag.mul(x.sub(from)));
        let Some([keep, gain, on]) = self.observer else {
            return self.lagged;
        };
        let y = self.lagged;
        let (from, left) = if first {
            (y, V::splat(0.0))
        } else {
            (self.observed, self.innovation)
        };
        //   s(k) = (1 - a) s(k-1) + y(k) - v(k-1)        innovation
        //   v(k) = v(k-1) + b s(k)                       observed speed
        // as `sewfast_control::observer` derives it.
        let innovation = keep.mul(left).add(y.sub(from));
        let speed = from.add(gain.mul(innovation));
        // A lane without an observer has keep = gain = 0 and would hold its first value: a selection passes its input
        // on.
        self.observed = on.if_equal(V::splat(1.0), speed, y);
        self.innovation = on.if_equal(V::splat(1.0), innovation, V::splat(0.0));
        self.observed
    }

    #[inline(always)]
    fn reference(&mut self, first: bool, r: f64) -> V {
        let r = V::splat(r);
        let Some(change) = self.ramp else {
            return r;
        };
        // A ramp begins where the machine is.
        let from = if first { self.filtered } else { self.r };
        self.r = limited(r, from.sub(change), from.add(change));
        self.r
    }

    #[inline(always)]
    fn control(&mut self, r: V, y: V, feedforward: Option<f64>) -> V {
        let zero = V::splat(0.0);
        //   u = Kp (e - alpha r) + I + D + feedforward
        //   I = I + (Kp Ts/Ti) e
        //   D = pole D + kd ((e - beta r) - (e - beta r) before)
        // in the order of operations of `Pid::step_by`, without fused products: the bits are the same on every level,
        // in a single loop and on a device.
        let e = r.sub(y);
        let input = e.sub(self.beta.mul(r));
        let change = input.sub(self.input);
        // NaN is not equal to itself, so the first sample has no change. A selection, because `sound` below can reset a
        // single lane.
        let change = self.input.if_equal(self.input, change, zero);
        let derivative = self.pole.mul(self.derivative).add(self.kd.mul(change));
        let integral = self.integral.add(self.ki.mul(e));
        let proportional = self.kp.mul(e.sub(self.alpha.mul(r)));
        let wanted = proportional.add(integral).add(derivative);
        let wanted = match feedforward {
            None => wanted,
            Some(added) => wanted.add(V::splat(added)),
        };
        // Limits first, slew after: the last command was within the limits, so every value between it and a limited one is, too.
        let mut u = limited(wanted, self.low, self.high);
        if let Some(change) = self.change {
            u = limited(u, self.u.sub(change), self.u.add(change));
        }
        let fading = derivative.abs().if_less(V::splat(FADED), zero, derivative);
        let new = [u, self.kept(integral, u.sub(wanted)), fading, input];
        // 0 if both are finite, else NaN
        // x * 0 is 0 for finite x, else NaN: two products and a sum instead of two comparisons and an AND.
        let sound = wanted.mul(zero).add(input.mul(zero));
        let old = [self.u, self.integral, self.derivative, self.input];
        [self.u, self.integral, self.derivative, self.input] =
            // Almost always true: a predicted branch saves four selections.
            if sound.abs().are_less(V::splat(1.0)) == V::ALL {
                new
            } else {
                [
                    sound.if_equal(zero, new[0], old[0]),
                    sound.if_equal(zero, new[1], old[1]),
                    sound.if_equal(zero, new[2], old[2]),
                    sound.if_equal(zero, new[3], old[3]),
                ]
            };
        self.u
    }

    /// The integral to keep if the limits moved the command by `excess`.
    #[inline(always)]
    fn kept(&self, integral: V, excess: V) -> V {
        let zero = V::splat(0.0);
        // At the upper limit excess = u - wanted is negative, and the integral's change is positive if it pushes
        // further: their product is negative. Conditional integration then holds the integral; back-calculation moves
        // it by Ts/Tt of the excess.
        let pushes_on = integral.sub(self.integral).mul(excess);
        let held = pushes_on.if_less(zero, self.integral, integral);
        let tracked = integral.add(self.tracking.mul(excess));
        let kept = self.conditional.if_equal(V::splat(1.0), held, tracked);
        let kept = excess.if_equal(zero, integral, kept);
        // Without integral action nothing winds up, and tracking would turn the excess into an offset that no error
        // removes.
        self.ki.if_equal(zero, integral, kept)
    }
}

impl InLanes for StateFeedback<f64> {
    type Lanes<V: Arithmetic> = StateLanes<V>;

    fn fits(&self, _first: &Self) -> bool {
        true
    }

    #[inline(always)]
    fn in_lanes<V: Arithmetic>(controllers: &[&Self]) -> StateLanes<V> {
        StateLanes::new(controllers)
    }
}

/// Eight [`StateFeedback`]s: the same operations in the same order.
pub(crate) struct StateLanes<V> {
    // Vectors of four for every order of plant: unused states are zero, so the code needs no loop of variable length.
    // That costs 16 products a sample.
    a: [V; STATES],
    b: [V; STATES],
    k: [V; STATES],
    l: [V; STATES],
    rest: [V; STATES],
    kr: V,
    ki: V,
    /// `lead` \[samples\].
    lead: V,
    /// Largest change of the reference in one sample; `None` if no lane has a ramp.
    ramp: Option<V>,
    low: V,
    high: V,
    /// Largest change of the command in one sample; `None` if no lane has a limit.
    change: Option<V>,
    /// States predicted for the next sample; after a measurement, corrected by it.
    x: [V; STATES],
    q: V,
    r: V,
    u: V,
    measured: V,
    /// The observed output.
    observed: V,
}

impl<V: Arithmetic> StateLanes<V> {
    /// The first eight of `controllers`, at rest; missing ones are the first again.
    #[inline(always)]
    fn new(controllers: &[&StateFeedback<f64>]) -> Self {
        let lane = |i: usize| controllers.get(i).unwrap_or(&controllers[0]).design();
        let each = |of: &dyn Fn(&StateDesign<f64>) -> f64| {
            V::load(&std::array::from_fn::<_, LANES, _>(|i| of(lane(i))))
        };
        let vector = |of: &dyn Fn(&StateDesign<f64>) -> [f64; STATES]| {
            std::array::from_fn(|state| each(&|d| of(d)[state]))
        };
        let any = |of: &dyn Fn(&StateDesign<f64>) -> bool| (0..LANES).any(|i| of(lane(i)));
        let zero = V::splat(0.0);
        let (low, high) = (each(&|d| d.u_min), each(&|d| d.u_max));
        Self {
            a: vector(&|d| d.a),
            b: vector(&|d| d.b),
            k: vector(&|d| d.k),
            l: vector(&|d| d.l),
            rest: vector(&|d| d.rest),
            kr: each(&|d| d.kr),
            ki: each(&|d| d.ki),
            lead: each(&|d| d.lead / d.ts),
            ramp: any(&|d| d.r_rate < f64::INFINITY).then_some(each(&|d| d.r_rate * d.ts)),
            low,
            high,
            change: any(&|d| d.slew < f64::INFINITY).then_some(each(&|d| d.slew * d.ts)),
            x: [zero; STATES],
            q: zero,
            r: zero,
            u: zero.at_least_each(low).at_most_each(high),
            measured: zero,
            observed: zero,
        }
    }
}

impl<V: Arithmetic> LaneController<V> for StateLanes<V> {
    #[inline(always)]
    fn take(&mut self, first: bool, measured: V) {
        // The measurement is not checked: the loop ends if it is not finite (`Loops::measure`), while a device's
        // controller has to go on.
        if first {
            self.x = self.rest.map(|x| x.mul(measured));
        }
        // x' = x + l (y - x1): from here until the prediction in `decide`, x is the corrected state.
        let innovation = measured.sub(self.x[0]);
        for (x, gain) in self.x.iter_mut().zip(self.l) {
            *x = x.add(gain.mul(innovation));
        }
        (self.measured, self.observed) = (measured, self.x[0]);
    }

    #[inline(always)]
    fn decide(&mut self, first: bool, r: f64, feedforward: Option<f64>) -> V {
        let (zero, y) = (V::splat(0.0), self.measured);
        let mut r = V::splat(r);
        if let Some(change) = self.ramp {
            let from = if first { y } else { self.r };
            r = limited(r, from.sub(change), from.add(change));
        }
        let before = if first { r } else { self.r };
        let ([k1, k2, k3, k4], [x1, x2, x3, x4]) = (self.k, self.x);
        // In pairs, as the law on a device adds them: a chain of two additions, not three.
        let fed_back = (k1.mul(x1).add(k2.mul(x2))).add(k3.mul(x3).add(k4.mul(x4)));
        // The reference extrapolated by `lead` samples at its present rate.
        let aimed = r.add(self.lead.mul(r.sub(before)));
        let wanted = self.kr.mul(aimed).sub(fed_back).add(self.q);
        let wanted = match feedforward {
            None => wanted,
            Some(added) => wanted.add(V::splat(added)),
        };
        let mut u = limited(wanted, self.low, self.high);
        if let Some(change) = self.change {
            u = limited(u, self.u.sub(change), self.u.add(change));
        }
        let (excess, change) = (u.sub(wanted), self.ki.mul(r.sub(y)));
        // The integral is held if the error pushes further beyond a limit, as in `kept` above.
        let mut q = change.mul(excess).if_less(zero, self.q, self.q.add(change));
        let shifted = [x2, x3, x4, zero];
        // x(k+1) = A x' + b u in observer form: A has -a in its first column and ones above the diagonal, so the product is a shift and
        // one multiplication per state. u is the limited command: the observer knows what the plant received.
        let mut x: [V; STATES] =
            std::array::from_fn(|i| shifted[i].sub(self.a[i].mul(x1)).add(self.b[i].mul(u)));
        // 0 if the command is finite, else NaN: then the observer starts over and the command is held
        let sound = wanted.mul(zero);
        if sound.abs().are_less(V::splat(1.0)) != V::ALL {
            u = sound.if_equal(zero, u, self.u);
            let kept = self.q.mul(zero).if_equal(zero, self.q, zero);
            q = sound.if_equal(zero, q, kept);
            for (x, rest) in x.iter_mut().zip(self.rest) {
                *x = sound.if_equal(zero, *x, rest.mul(y));
            }
        }
        (self.x, self.q, self.r, self.u) = (x, q, r, u);
        u
    }

    #[inline(always)]
    fn filtered(&self) -> V {
        self.observed
    }
}

/// The nearest value in `[low, high]`; NaN stays NaN.
#[inline(always)]
fn limited<V: Arithmetic>(value: V, low: V, high: V) -> V {
    value.at_least_each(low).at_most_each(high)
}

/// Eight [`sewfast_control::filter::MovingAverage`]s.
struct Averages<V> {
    /// Room for the longest; slots beyond a lane's own length are zero and do not change its sum.
    // Slot by slot, eight loops each, in the order of the ring, not of age. The scalar average adds in that order, and
    // the last bits of a sum depend on it.
    slots: Vec<V>,
    lengths: V,
    /// The length, if it is the same for all.
    common: bool,
    /// Where the next sample goes.
    next: usize,
    /// The same per lane, if lengths differ.
    nexts: V,
}

impl<V: Arithmetic> Averages<V> {
    #[inline(always)]
    fn new(lengths: [usize; LANES]) -> Self {
        let longest = lengths.into_iter().max().unwrap_or(1);
        Self {
            slots: vec![V::splat(0.0); longest],
            lengths: V::load(&lengths.map(|n| n as f64)),
            common: lengths == [longest; LANES],
            next: 0,
            nexts: V::splat(0.0),
        }
    }

    /// Takes samples and returns the averages; the first sample fills the memory.
    #[inline(always)]
    fn step(&mut self, first: bool, x: V) -> V {
        if self.common && self.slots.len() == 1 {
            // the lag that follows maps -0 and 0 to the same value
            return x;
        }
        if first {
            for j in 0..self.slots.len() {
                let place = V::splat(j as f64);
                self.slots[j] = place.if_less(self.lengths, x, V::splat(0.0));
            }
        }
        // Summed anew each time: a running sum would drift, here as in the scalar average.
        let sum = if self.common {
            self.alike(x)
        } else {
            self.apart(x)
        };
        // A division, as in the scalar average; multiplying by 1/n rounds differently.
        sum.div(self.lengths)
    }

    /// The sum if all have one length.
    #[inline(always)]
    fn alike(&mut self, x: V) -> V {
        self.slots[self.next] = x;
        let next = self.next + 1;
        self.next = if next < self.slots.len() { next } else { 0 };
        let mut sum = V::splat(0.0);
        // One addition after the other, as their order is part of the result; the other groups' turns fill the waiting.
        // This special case saves 4 to 6 % per candidate.
        for j in 0..self.slots.len() {
            sum = sum.add(self.slots[j]);
        }
        sum
    }

    /// The sum if lengths differ.
    #[inline(always)]
    fn apart(&mut self, x: V) -> V {
        let mut sum = V::splat(0.0);
        for j in 0..self.slots.len() {
            // Each lane has its own position: every slot is offered the sample and only the lanes at that position take it.
            let kept = self.nexts.if_equal(V::splat(j as f64), x, self.slots[j]);
            self.slots[j] = kept;
            sum = sum.add(kept);
        }
        let next = self.nexts.add(V::splat(1.0));
        self.nexts = next.if_less(self.lengths, next, V::splat(0.0));
        sum
    }
}
