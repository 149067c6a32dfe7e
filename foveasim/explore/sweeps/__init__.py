"""Sweeps: one shot at many settings."""
