"""Benchmarks of CPN against planning and training in PyTorch, JAX and ONNX Runtime, in interleaved turns."""
