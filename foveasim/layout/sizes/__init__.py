"""Sizes of layouts: numbers of sites, optical formats, and layouts from sizes."""
