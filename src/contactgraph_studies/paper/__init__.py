"""The study of models: the paper's comparison of predictions and of control by them."""
