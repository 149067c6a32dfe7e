"""Sensors from frames of a camera."""
