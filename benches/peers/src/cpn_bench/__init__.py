"""Planning and training in PyTorch, JAX and ONNX Runtime, and the turns they take with ours."""
