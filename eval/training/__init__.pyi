from .dataset import Recipe, make_shard, make_shards
from .dataset_run import make_dataset
from .training_run import train_descriptor

__all__ = [
    "Recipe",
    "make_dataset",
    "make_shard",
    "make_shards",
    "train_descriptor",
]
