"""Sweeps: captures of one shot with varied settings."""
