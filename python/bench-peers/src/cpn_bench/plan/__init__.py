"""Benchmark of planning, as a library and as a service."""
