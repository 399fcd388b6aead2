"""A result folder as `sewfast demo` leaves it, from a few lines of numpy."""

import json
from pathlib import Path

import numpy as np

from sewfast.report.artefacts import (
    MODELS,
    PLANTS,
    RECORDINGS,
    REFERENCES,
    SCORED,
    prediction_file,
    record_of,
    recording_file,
    run_file,
)

TS = 0.001
READINGS = (
    "per_sample_rpm", "continuous_rpm", "per_sample_cps", "continuous_cps", "per_sample_krpm",
)  # fmt: skip


def drive(u: np.ndarray) -> np.ndarray:
    """Speed of the plant of the paper's Eq. 8, held where 20 V would hold it."""
    y = np.zeros(len(u))
    for k in range(2, len(u)):
        y[k] = 1.87 * y[k - 1] - 0.8705 * y[k - 2] + 0.1228 * u[k - 1] + 0.1224 * u[k - 2]
    return y


def command(record: str, t: np.ndarray) -> np.ndarray:
    """A command [V] that resembles the record's."""
    sweep = np.sin(2 * np.pi * (0.1 * t + 2.9 * t**2 / (2 * t[-1])) - np.pi / 2)
    growing = t / t[-1]
    return {
        "step": np.where(t > 0.5, 4.0, 0.0),
        "chirp_lo_hi": 3.0 * growing * (1 + sweep),
        "chirp_hi_lo": 3.0 * (1.1 - growing) * (1 + sweep),
        "random": 3.0 + 2.0 * np.sin(7 * np.floor(2 * t) ** 2),
        "saturating": 4.0 + 6.0 * np.sign(np.sin(5 * t)),
        "saturating_2": 4.0 + 6.0 * np.sign(np.sin(4 * t + 1)),
        "closed_loop": 2.0 + 2.0 * np.sign(np.sin(3 * t)),
    }[record]


def recording(record: str, samples: int) -> dict[str, np.ndarray]:
    t = TS * np.arange(samples)
    u = command(record, t)
    speed = drive(u)
    counts = np.floor(np.cumsum(speed) * TS * 1572 / 60)
    noise = np.random.default_rng(len(record)).normal(0.0, 0.6, samples)
    return {"t": t, "u": u, "counts": counts, "y": speed + noise, "speed_true": speed}


def predictions(speed: np.ndarray) -> dict[str, np.ndarray]:
    wave = np.sin(np.arange(len(speed)) / 150.0)
    sizes = dict(zip(MODELS, (30.0, 6.0, 18.0, 20.0, 25.0, 250.0), strict=True))
    found = {f"{m}_simulation": speed + size * wave for m, size in sizes.items()}
    return found | {f"{m}_one_step": speed + 0.02 * size * wave for m, size in sizes.items()}


def closed_loop(reference: str, plant: str, samples: int) -> dict[str, np.ndarray]:
    t = TS * np.arange(samples)
    r = 400.0 * command("chirp_lo_hi", t)
    if reference in ("trapezoid", "paper_gains"):
        r = np.interp(t, [0.2, 0.35, 0.8, 0.95], [0.0, 3000.0, 3000.0, 0.0])
    lag = 6 if plant == "model" else 8
    y = np.concatenate([np.zeros(lag), r[:-lag]])
    return {"t": t, "r": r, "u": np.clip(r / 490 + np.gradient(r, TS) / 2000, -20, 20), "y": y,
            "feedback": np.round(y / 5) * 5}  # fmt: skip


def results() -> dict[str, object]:
    """Values of `results.json`; each goal of the report is reached."""
    scores = {
        "paper": 30.0,
        "neural_oe": 6.0,
        "oe": 18.0,
        "oe_all": 20.0,
        "arx": 25.0,
        "arx_raw": 250.0,
    }
    identification = {
        m: {
            r: {
                "simulation": {"rmse_rpm": size, "fit_percent": 100 - size / 10},
                "one_step": {"rmse_rpm": size / 50, "fit_percent": 99.99},
            }
            for r in SCORED
        }
        | {"trained_on": ["chirp_lo_hi"], "seconds": 0.4, "parameters": 49}
        for m, size in scores.items()
    }
    identification["paper"] |= {
        "cost": 1.2e-4, "cost_floor": 8e-5, "cost_true": 5e-5, "cost_one_step": 9e-7,
        "cost_ideal": 4e-5,
        "iterations": 100,
    }  # fmt: skip
    loop = {
        "rmse_rpm": 9.0,
        "rise_time_ms": 124.0,
        "overshoot_percent": 1.2,
        "effort_v": 5.0,
        "chatter_v": 0.2,
    }
    control: dict[str, dict[str, object]] = {
        r: {p: dict(loop) for p in PLANTS} | {"model_vs_machine_rmse_rpm": 4.5} for r in REFERENCES
    }
    control["trapezoid"]["reference_rise_time_ms"] = 120.0
    gains = {"Kp": 0.02, "Ti": 0.05, "Td": 0.004, "alpha": 0.4, "beta": 0.2}
    method = {"rmse_rpm": 0.6, "cost_floor": 1.8e-7}
    return {
        "sewfast": "0.0.0",
        "machine": "virtual",
        "seed": 0,
        "seconds": 20.0,
        "counts_per_rev": 1572,
        "limits": {"u_min": -20.0, "u_max": 20.0},
        "speed": {"difference": {"rmse_rpm": 15.0, "cost_floor": 1.1e-4}, "savgol": method,
                  "kalman": method},
        "identification": identification,
        "fopdt": {"K": 480.0, "T": 0.26, "L": 0.007, "offset": 0.0, "u_low": 0.0, "u_high": 4.0,
                  "fit_percent": 98.0},
        "table_1": {"ratio": 0.027, "ratio_used": 0.1, "in_range": False},
        "gains": {k: dict(gains) for k in ("paper", "coarse", "tuned")},
        "tuning": {"evaluations": 3000, "cost": 1.0, "start_cost": 7.0},
        "control": control,
        "paper_gains": {p: loop | {"rmse_rpm": 130.0} for p in ("eq8", "machine")}
        | {"readings": dict.fromkeys(READINGS, loop)},
    }  # fmt: skip


def make(folder: Path, samples: int = 1200) -> Path:
    """Write the whole folder; `samples` per recording and run."""
    for name in ("recordings", "predictions", "runs"):
        (folder / name).mkdir(parents=True)
    columns = {r: recording(r, samples) for r in RECORDINGS}
    for r, c in columns.items():
        rows = np.column_stack(list(c.values()))
        header = "t [s],u [V],counts,y [RPM],speed_true [RPM]"
        np.savetxt(folder / recording_file(r), rows, delimiter=",", header=header, comments="")
    for r in SCORED:
        np.savez(folder / prediction_file(r), **predictions(columns[record_of(r)]["speed_true"]))
    loops = [(r, p) for r in REFERENCES for p in PLANTS]
    for key in [*loops, ("paper_gains", "eq8"), ("paper_gains", "machine")]:
        np.savez(folder / run_file(*key), **closed_loop(*key, samples))
    document = {"format": "sewfast.results", "version": 1, **results()}
    (folder / "results.json").write_text(json.dumps(document))
    return folder
