"""Shared code: validation, packed rings, random streams, threads, kernels, provenance."""
