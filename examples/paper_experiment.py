"""The paper's whole experiment on the virtual sewing machine, with its report."""

import tempfile
from pathlib import Path

from sewfast.experiment import run_demo

with tempfile.TemporaryDirectory() as name:
    folder = Path(name)
    results = run_demo(folder, seed=0, progress=lambda done, total, stage: print(stage))
    print((folder / "report.html").stat().st_size // 1024, "kB of report")

for model in ("paper", "neural_oe", "oe"):
    error = results["identification"][model]["random"]["simulation"]["rmse_rpm"]
    print(f"{model:10} {error:8.2f} RPM rms in free run on the random record")
