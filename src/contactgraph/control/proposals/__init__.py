"""Proposals of starts for `MultiStartILQR`; `contactgraph.control` has their names."""
