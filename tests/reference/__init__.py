"""Slow reference implementations of algorithms of the package."""
