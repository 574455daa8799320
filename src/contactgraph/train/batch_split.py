"""Batches split over several devices: each takes a part of the windows, all have the model."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from contactgraph.data.errors import InvalidInputError

Tree = TypeVar("Tree")

_WINDOWS = "windows"


@dataclass(frozen=True)
class BatchSplit:
    """Devices in a row. XLA adds up what they find, once a step, for the gradient."""

    mesh: Mesh

    def parted(self, batch: Tree) -> Tree:
        """Every array's leading axis, which is the windows', is split over the devices."""
        return eqx.filter_shard(batch, NamedSharding(self.mesh, PartitionSpec(_WINDOWS)))

    def everywhere(self, tree: Tree) -> Tree:
        """Every device has all of it."""
        return eqx.filter_shard(tree, NamedSharding(self.mesh, PartitionSpec()))


def batch_split(devices: Sequence[jax.Device], batch_size: int) -> BatchSplit | None:
    """None for fewer than two devices: nothing is split.

    Raises `InvalidInputError` where the windows of a batch do not come out even.
    """
    if len(devices) < 2:
        return None
    if batch_size % len(devices):
        raise InvalidInputError(
            f"a batch of {batch_size} windows cannot be split evenly over {len(devices)} devices"
        )
    return BatchSplit(Mesh(np.asarray(devices), (_WINDOWS,)))
