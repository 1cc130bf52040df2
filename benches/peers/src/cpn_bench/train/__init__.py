"""Training steps of the compared methods."""
