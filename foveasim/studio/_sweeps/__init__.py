"""Sweeps of one or two settings of a session, and their files."""

from foveasim.studio._sweeps.running import Sweeps

__all__ = ["Sweeps"]
