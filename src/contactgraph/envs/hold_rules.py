"""Rules that tie bodies of a `PlanarWorld` together."""

from contactgraph.envs.planar_world import PlanarWorld


class HoldAtTouch:
    """Ties together all bodies that touch, for good."""

    def reset(self, world: PlanarWorld) -> None:
        """Keeps no state."""

    def update(self, world: PlanarWorld, dt: float) -> None:
        """Joins the pairs that touch now."""
        for first, second in sorted(world.touching_pairs):
            world.join(first, second)
