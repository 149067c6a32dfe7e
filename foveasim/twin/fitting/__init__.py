"""Fit of the chain of a sensor to the statistics of stacks."""
