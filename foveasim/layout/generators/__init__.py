"""Generators of layouts, one module per family."""
