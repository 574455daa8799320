"""The pickup model in eager PyTorch, as a paper's author would write it, for comparison.

The same equations (`docs/model.md`) with the same weights, for scenes without hinges and weight:
`torch.nn.GRUCell` along the edges in a loop over time, everything else over all steps at once where
the equations allow it; plans by a Riccati recursion in a NumPy loop.
"""
