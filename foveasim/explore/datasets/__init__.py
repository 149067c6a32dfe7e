"""Datasets of labelled captures for machine learning."""
