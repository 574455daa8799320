"""A Franka arm: the law that makes its hand a mass, and the driver over the maker's client."""
