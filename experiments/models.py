"""The shipped checkpoints from nothing: demonstrations of all 24 tasks, then a training run for each checkpoint.

An interrupted run resumes.
"""

from dataset import DATASET, record
from lab import ROOT, Lab, main, on_every_core, train

# The four tasks that the paper names are never trained on; see docs/decisions/0004-demonstration-tasks.md.
HELD_OUT = "door-lock,drawer-close,dial-turn,coffee-button"
PRESETS = {
    "cpn": "paper-cpn",
    "upn": "paper-upn",
    "te-bc": "paper-te-bc",
    "bc": "paper-bc",
    "cpn-position": "cpn-position",
}
"""Preset of each checkpoint."""
# All trained as the preset cpn is.
SETTINGS = ("training.epochs=5", "training.samples_per_draw=8", "training.precision=bfloat16")


def models() -> None:
    """Trains the checkpoints in models/, one run a core: the weights are the same on any number of cores."""
    record()
    options = ["--dataset", str(DATASET), "--hold-out", HELD_OUT]
    options += [option for setting in SETTINGS for option in ("--set", setting)]
    with Lab(ROOT / "runs/models") as lab:
        on_every_core(
            lambda name: train(lab, ROOT / f"models/{name}.safetensors", "--preset", PRESETS[name], *options),
            PRESETS,
        )


if __name__ == "__main__":
    main(models)
