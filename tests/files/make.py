"""Writes the model files of this version and what they answer: run once for each released version.

    python tests/files/make.py

Files of earlier versions stay as they are: they have to remain readable.
"""

import json
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "support"))

import numpy as np  # noqa: E402

import sewfast  # noqa: E402
from plants import bent_data  # noqa: E402
from sewfast.models import Ensemble  # noqa: E402

FEW = {"iterations": 6, "starts": 2, "hidden": 2}


def main() -> None:
    """One file for each kind, and the free run of each on one input."""
    folder = HERE / sewfast.__version__
    folder.mkdir(exist_ok=True)
    data = bent_data(200, noise=0.01)
    made = {k: sewfast.identify(data, model=k) for k in ("arx", "iv", "oe")}
    made["neural_oe"] = sewfast.identify(data, model="neural_oe", **FEW)
    found = sewfast.identify(data, model="neural_ss", nx=2, nk=1, **FEW)
    single = found.members[0] if isinstance(found, Ensemble) else found
    made["neural_ss"] = single
    made["ensemble"] = Ensemble.of([single, made["neural_oe"], made["oe"]])
    answers = {}
    for kind, model in made.items():
        assert model.kind == kind
        model.save(folder / f"{kind}.json")
        answers[kind] = model.simulate(bent_data(40, seed=3), init=0)[0].tolist()
    (folder / "answers.json").write_text(json.dumps(answers, indent=1) + "\n")
    print(f"{len(made)} files in {folder}, numpy {np.__version__}")


if __name__ == "__main__":
    main()
