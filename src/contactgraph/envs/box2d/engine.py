"""The one file that imports Box2D, and what all worlds on it share."""

import warnings

with warnings.catch_warnings():
    # Its wrapper warns of a deprecation when imported; where warnings are errors, it crashes.
    warnings.simplefilter("ignore", DeprecationWarning)
    import Box2D as Box2D

SIMULATOR = f"box2d {Box2D.__version__}"

VELOCITY_ITERATIONS = 20
POSITION_ITERATIONS = 5


class TouchListener(Box2D.b2ContactListener):
    """Notes pairs that begin to touch; the world is locked then, so that is all it may do."""

    def __init__(self) -> None:
        super().__init__()
        self.touched: list[tuple[int, int]] = []

    def BeginContact(self, contact: Box2D.b2Contact) -> None:
        """Called by Box2D, hence the name."""
        pair = sorted((contact.fixtureA.body.userData, contact.fixtureB.body.userData))
        self.touched.append((pair[0], pair[1]))
