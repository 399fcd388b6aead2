//! Controllers, one in each lane; or a single one.

use sewfast_control::{
    AnyController, BIQUADS, Biquad, Controller, Numbers, PidController, STATES, StateDesign,
    StateFeedback,
};

use crate::simd::{Arithmetic, LANES};

/// A kind of controller that runs in lanes.
pub(crate) trait InLanes: Controller<f64> {
    /// Eight of them, or a single one.
    type Lanes<V: Arithmetic>: LaneController<V>;

    /// Whether this one can, beside the `first`.
    fn fits(&self, first: &Self) -> bool;

    /// The first eight of `controllers`, at rest; missing ones are the first again.
    fn in_lanes<V: Arithmetic>(controllers: &[&Self]) -> Self::Lanes<V>;
}

/// What a loop asks of the controllers in its lanes: in two parts, between which other work can be done.
pub(crate) trait LaneController<V> {
    /// Takes measured outputs.
    // In two because of `Decision`: filters go on while the plants of another group step.
    fn take(&mut self, first: bool, measured: V);
    /// From the reference and what was taken to the commands.
    fn decide(&mut self, first: bool, r: f64, feedforward: Option<f64>) -> V;
    /// The feedback after its filter, at the last sample.
    fn filtered(&self) -> V;
}

/// Work on controllers of one kind, whichever it is.
pub(crate) trait WithKind {
    /// What comes out.
    type Output;

    /// Does it.
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

/// The controllers within, where each has one that fits in lanes.
fn all<'a, C: InLanes>(
    controllers: &[&'a AnyController<f64>],
    within: impl Fn(&'a AnyController<f64>) -> Option<&'a C>,
) -> Option<Vec<&'a C>> {
    let first = within(controllers.first()?)?;
    let fitting = |c: &&'a AnyController<f64>| within(c).filter(|c| c.fits(first));
    // `Option<Vec>`: one that does not fit sends all of them to the scalar loop, which has the same bits.
    controllers.iter().map(fitting).collect()
}

impl InLanes for PidController<f64> {
    type Lanes<V: Arithmetic> = Controllers<V>;

    fn fits(&self, first: &Self) -> bool {
        let sections = |c: &Self| c.design().biquads.sections().len();
        self.numbers().is_some() && sections(self) == sections(first)
    }

    #[inline(always)]
    fn in_lanes<V: Arithmetic>(controllers: &[&Self]) -> Controllers<V> {
        Controllers::new(controllers)
    }
}

/// A derivative term below this is nothing: in a loop at rest it would fade on for ever among numbers so small that processors
/// take a hundred times as long over them.
// Measured as a loop at rest that was slower threefold. What is dropped is beyond every digit of a command.
const FADED: f64 = 1e-280;

/// Eight cascades of biquads with as many sections each, and what they remember of feedback and reference.
struct Cascades<V> {
    count: usize,
    /// `c0`, `c1`, `a1` and `-a2` of each section.
    sections: [[V; 4]; BIQUADS],
    of_y: [[V; 3]; BIQUADS],
    of_r: [[V; 3]; BIQUADS],
}

impl<V: Arithmetic> Cascades<V> {
    /// Of the first eight controllers; missing ones are the first again.
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

    /// The next sample of the feedback; the first one finds it at rest there.
    #[inline(always)]
    fn feedback(&mut self, first: bool, y: V) -> V {
        let sections = &self.sections[..self.count];
        Self::step(sections, &mut self.of_y, first.then_some(y), y)
    }

    /// The next sample of the reference; the first one finds it at rest at the output `y`.
    #[inline(always)]
    fn reference(&mut self, first: bool, y: V, r: V) -> V {
        let sections = &self.sections[..self.count];
        Self::step(sections, &mut self.of_r, first.then_some(y), r)
    }

    /// The next sample of a signal, which was at rest at `before` if this is its first.
    #[inline(always)]
    fn step(sections: &[[V; 4]], memory: &mut [[V; 3]; BIQUADS], before: Option<V>, x: V) -> V {
        let mut x = x;
        for (&[c0, c1, a1, a2], state) in sections.iter().zip(memory) {
            if let Some(level) = before {
                *state = [level, V::splat(0.0), V::splat(0.0)];
            }
            // `Memory::step` of the crate `sewfast_control`; -(a2 d) and (-a2) d are the same bits
            let [last, s1, s2] = *state;
            let change = x.sub(last);
            let d = c0.mul(change).add(s1);
            *state = [x, c1.mul(change).sub(a1.mul(d)).add(s2), a2.mul(d)];
            x = x.add(d);
        }
        x
    }
}

/// Eight of [`PidController`] with constant gains: the same operations in the same order.
pub(crate) struct Controllers<V> {
    average: Averages<V>,
    lag: V,
    /// `1 - a`, `b`, and 1 where there is an observer; `None` where no lane has one.
    // `None` in these three is a branch that all samples take alike: a stage that no lane has is not computed. Where
    // some have it, the others compute it with numbers that leave no trace (no ramp: an infinite change), or choose.
    observer: Option<[V; 3]>,
    /// Largest change of the reference in one sample; `None` where no lane has a ramp.
    ramp: Option<V>,
    // Behind a pointer: arrays that are indexed would keep all of this out of registers, also where there are none (5 % more
    // instructions in a loop without).
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
    /// Largest change of the command in one sample; `None` where no lane has a limit.
    change: Option<V>,
    lagged: V,
    observed: V,
    innovation: V,
    r: V,
    /// The derivative's input at the last sample; NaN before the first.
    // `e - beta r` as it was, where the scalar law keeps e and r and forms it again: the same bits from the same
    // operations, and one value less to hold.
    input: V,
    derivative: V,
    integral: V,
    u: V,
    /// The feedback after its filter, at the last step.
    pub filtered: V,
}

impl<V: Arithmetic> Controllers<V> {
    /// The first eight of `controllers`, at rest; missing ones are the first again.
    #[inline(always)]
    pub fn new(controllers: &[&PidController<f64>]) -> Self {
        let lane = |i: usize| *controllers.get(i).unwrap_or(&controllers[0]);
        let number = |i: usize| lane(i).numbers();
        // `dyn` and not generic: this runs once a candidate, and a copy for each of sixteen settings would be most of the
        // code.
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
            // As `Pid::reset`: slew counts from 0 or the limit next to it.
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
        // `first` is one flag for all lanes, since all begin at the same sample: a branch and no selection.
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
        // A lane without an observer has keep = gain = 0 and would hold its first value: it passes its input on by
        // choice.
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
        // in the order of operations of `Pid::step_by`, and no product fused: on every level, alone and on a device, the
        // same bits.
        let e = r.sub(y);
        let input = e.sub(self.beta.mul(r));
        let change = input.sub(self.input);
        // NaN is not equal to itself, so that the first sample has no change; a selection, because `sound` below can put
        // one lane back.
        let change = self.input.if_equal(self.input, change, zero);
        let derivative = self.pole.mul(self.derivative).add(self.kd.mul(change));
        let integral = self.integral.add(self.ki.mul(e));
        let proportional = self.kp.mul(e.sub(self.alpha.mul(r)));
        let wanted = proportional.add(integral).add(derivative);
        let wanted = match feedforward {
            None => wanted,
            Some(added) => wanted.add(V::splat(added)),
        };
        // Limits first, slew after: the last command was within the limits, and so is all between it and a value within.
        let mut u = limited(wanted, self.low, self.high);
        if let Some(change) = self.change {
            u = limited(u, self.u.sub(change), self.u.add(change));
        }
        let fading = derivative.abs().if_less(V::splat(FADED), zero, derivative);
        let new = [u, self.kept(integral, u.sub(wanted)), fading, input];
        // 0 where both are finite, else NaN
        // x 0 is 0 for finite x, else NaN: two products and a sum instead of two comparisons and an AND.
        let sound = wanted.mul(zero).add(input.mul(zero));
        let old = [self.u, self.integral, self.derivative, self.input];
        [self.u, self.integral, self.derivative, self.input] =
            // Hardly ever not: four selections are saved for a branch that is foretold.
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

    /// The integral to keep when the limits moved the command by `excess`.
    #[inline(always)]
    fn kept(&self, integral: V, excess: V) -> V {
        let zero = V::splat(0.0);
        // excess = u - wanted is negative at the upper limit, and the integral's change then positive where it pushes
        // on: their product is negative. Conditional integration holds the integral there; back-calculation moves it by
        // Ts/Tt of the excess.
        let pushes_on = integral.sub(self.integral).mul(excess);
        let held = pushes_on.if_less(zero, self.integral, integral);
        let tracked = integral.add(self.tracking.mul(excess));
        let kept = self.conditional.if_equal(V::splat(1.0), held, tracked);
        let kept = excess.if_equal(zero, integral, kept);
        // Without integral action there is nothing to wind up, and tracking would make an offset out of the excess that
        // no error takes back.
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

/// Eight of [`StateFeedback`]: the same operations in the same order.
pub(crate) struct StateLanes<V> {
    // Vectors of four whatever the plant's order: states that are not used have zeros, and the code no loop over a
    // number of its own. What is used costs 16 products a sample.
    a: [V; STATES],
    b: [V; STATES],
    k: [V; STATES],
    l: [V; STATES],
    rest: [V; STATES],
    kr: V,
    ki: V,
    /// In samples.
    lead: V,
    /// Largest change of the reference in one sample; `None` where no lane has a ramp.
    ramp: Option<V>,
    low: V,
    high: V,
    /// Largest change of the command in one sample; `None` where no lane has a limit.
    change: Option<V>,
    /// States as predicted for the next sample; once a measurement was taken, as corrected by it.
    x: [V; STATES],
    q: V,
    r: V,
    u: V,
    measured: V,
    /// The output as observed.
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
        // Nothing is asked of the measurement: the loop ends where it is not finite (`Loops::measure`), while the
        // controller of a device has to go on.
        if first {
            self.x = self.rest.map(|x| x.mul(measured));
        }
        // x' = x + l (y - x1): from here to the prediction in `decide` x is the corrected state.
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
        // In pairs, as the law on a device adds them: a chain of two additions instead of three.
        let fed_back = (k1.mul(x1).add(k2.mul(x2))).add(k3.mul(x3).add(k4.mul(x4)));
        // The reference as it will be after `lead` samples at its present rate.
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
        // The integral stands where the error pushes further beyond a limit, as `kept` above has it.
        let mut q = change.mul(excess).if_less(zero, self.q, self.q.add(change));
        let shifted = [x2, x3, x4, zero];
        // x(k+1) = A x' + b u in observer form: A has -a in its first column and ones above the diagonal, so that the
        // product is a shift and one multiplication a state. u as limited: the observer knows what the plant got.
        let mut x: [V; STATES] =
            std::array::from_fn(|i| shifted[i].sub(self.a[i].mul(x1)).add(self.b[i].mul(u)));
        // 0 where the command is finite, else NaN: then the observer begins again, and the command stays
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

/// Eight of [`sewfast_control::filter::MovingAverage`].
struct Averages<V> {
    /// Room for the longest; beyond a lane's own length there are zeros, which a sum does not feel.
    // Slot by slot, eight loops each. In the ring's places and not in the order of age, which is the order in which the
    // scalar average adds them: a sum's last bits depend on it.
    slots: Vec<V>,
    lengths: V,
    /// The length of all, where it is the same.
    common: bool,
    /// Where the next sample goes.
    next: usize,
    /// The same by lane, where lengths differ.
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

    /// Takes samples, gives the averages; the first fill the memory.
    #[inline(always)]
    fn step(&mut self, first: bool, x: V) -> V {
        if self.common && self.slots.len() == 1 {
            // the lag that follows makes the same of -0 and of 0
            return x;
        }
        if first {
            for j in 0..self.slots.len() {
                let place = V::splat(j as f64);
                self.slots[j] = place.if_less(self.lengths, x, V::splat(0.0));
            }
        }
        // Formed anew each time: a running sum would drift, here as in the scalar average.
        let sum = if self.common {
            self.alike(x)
        } else {
            self.apart(x)
        };
        // A division as there; 1/n times the sum rounds differently.
        sum.div(self.lengths)
    }

    /// The sum where all have one length.
    #[inline(always)]
    fn alike(&mut self, x: V) -> V {
        self.slots[self.next] = x;
        let next = self.next + 1;
        self.next = if next < self.slots.len() { next } else { 0 };
        let mut sum = V::splat(0.0);
        // One addition after the other, as their order is part of the result; the groups of loops that take turns fill
        // the waiting. 4 to 6 % of a candidate by this special case.
        for j in 0..self.slots.len() {
            sum = sum.add(self.slots[j]);
        }
        sum
    }

    /// The sum where lengths differ.
    #[inline(always)]
    fn apart(&mut self, x: V) -> V {
        let mut sum = V::splat(0.0);
        for j in 0..self.slots.len() {
            // Each lane has its own place: every slot is offered the sample, and one lane or other takes it.
            let kept = self.nexts.if_equal(V::splat(j as f64), x, self.slots[j]);
            self.slots[j] = kept;
            sum = sum.add(kept);
        }
        let next = self.nexts.add(V::splat(1.0));
        self.nexts = next.if_less(self.lengths, next, V::splat(0.0));
        sum
    }
}
