"""A tiny model, one whose opacities are off, and photographs, as in the tests of fine-tuning."""

from finetune.conftest import dataset as dataset  # a fixture, as the others are
from finetune.conftest import model as model
from finetune.conftest import truth as truth
