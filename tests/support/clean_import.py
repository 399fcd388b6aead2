"""What must work where only numpy is installed; run by `make package` in a clean environment."""

import sys
from importlib.metadata import distributions, entry_points
from importlib.resources import files

has_lock = getattr(sys, "_is_gil_enabled", lambda: True)()

import sewfast  # noqa: E402

installed = {d.name for d in distributions()}
assert installed <= {"sewfast", "numpy", "pip", "setuptools"}, installed
assert "numpy" not in sys.modules, "import sewfast alone should load nothing"

for name in sewfast.__all__:
    getattr(sewfast, name)

plugins = entry_points(group="sewfast.commands")
assert {point.name for point in plugins} >= {"demo", "deploy", "fleet", "pil", "studio"}
for point in plugins:
    point.load()
assert callable(sewfast.fleet)
assert files("sewfast_studio").joinpath("page/index.html").is_file()

machine = sewfast.VirtualMachine(1)
u = sewfast.signals.excitation("step")
run = machine.run(u)
speed = sewfast.speed_from_counts(run.counts, machine.Ts, machine.counts_per_rev)
data = sewfast.Dataset.from_arrays(u, speed, machine.Ts, input_units="V", output_unit="RPM")
model = sewfast.identify(data, model="oe")
assert sewfast.validate(model, data).simulation.fit_percent > 90.0
assert "scipy" not in sys.modules
assert "matplotlib" not in sys.modules
# a free-threaded interpreter locks itself for an extension that does not say that it needs no lock
assert getattr(sys, "_is_gil_enabled", lambda: True)() == has_lock

print("sewfast", sewfast.__version__, "works with numpy alone")
