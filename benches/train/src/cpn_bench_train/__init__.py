"""Training steps of the compared methods in PyTorch and JAX, and the turns they take with ours."""
