"""Datasets: many captures with labels, for learning."""
