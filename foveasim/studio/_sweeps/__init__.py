"""Sweeps of one or two settings of a session, and their files."""

from foveasim.studio._sweeps.request import axes_of, results_of
from foveasim.studio._sweeps.running import Sweep, Sweeps

__all__ = ["Sweep", "Sweeps", "axes_of", "results_of"]
