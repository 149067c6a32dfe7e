"""Sizes of layouts: numbers of sites, optical formats, and parameters of generators for them."""
