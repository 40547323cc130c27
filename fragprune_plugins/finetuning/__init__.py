"""Fine-tuning a trained splat on its photographs or its own pictures, without a host."""

from fragprune_plugins.datasets.dataset import Dataset, Shot, load_dataset
from fragprune_plugins.finetuning.itself import own_pictures
from fragprune_plugins.finetuning.loop import FinetuneResult, finetune, save
from fragprune_plugins.finetuning.resuming import Checkpoints

__all__ = [
    "Checkpoints",
    "Dataset",
    "FinetuneResult",
    "Shot",
    "finetune",
    "load_dataset",
    "own_pictures",
    "save",
]
