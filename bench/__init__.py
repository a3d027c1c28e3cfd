"""Measurements: a benchmark writes JSON with machine, commit and settings, and charts are drawn from that JSON alone.

`raster` and `rd` are behind `gscodec bench`; `run` measures the whole pipeline; results/ and charts/ are published.
"""
