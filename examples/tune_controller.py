"""Tune a controller on a model alone, then compare its prediction with the machine."""

import numpy as np

import sewfast

machine = sewfast.VirtualMachine(seed=2)
u = sewfast.signals.excitation("multisine")
counts = machine.run(u).counts
speed = sewfast.speed_from_counts(counts, machine.Ts, machine.counts_per_rev)
data = sewfast.Dataset.from_arrays(u, speed, machine.Ts, input_units="V", output_unit="RPM")
model = sewfast.identify(data, model="neural_oe", starts=2)

# the required motion: 300 to 1,500 RPM and back, each in half a second
t = machine.Ts * np.arange(2000)
reference = np.interp(t, [0.2, 0.7, 1.2, 1.7], [300.0, 1500.0, 1500.0, 300.0])

tuned = sewfast.tune(model, reference, u_min=-10, u_max=10, counts_per_rev=1572, evaluations=400)
for form in ("standard", "parallel", "per_sample"):
    print(tuned.controller.gains.to(form, Ts=machine.Ts))

predicted = sewfast.run(tuned.controller, model, reference)
machine.reset()
measured = sewfast.run(tuned.controller, machine, reference)
difference = np.sqrt(np.mean((predicted.y - measured.y) ** 2))
print(measured)
print(f"the prediction was off by {difference:.1f} RPM rms")
assert difference < 15.0, difference
assert measured.metrics()["overshoot_percent"] < 3.0, measured
