"""Benchmarks: each writes a JSON with machine, commit and settings to results/; plots/ draws charts from these alone.

gscodec bench NAME       raster, rd, train, ablation, stress: tables with an entry per setting
python -m bench.NAME     run (the whole pipeline), player, fuzz, layers, positions, rate_term, picture, animate_splat,
                         rendered_room
baselines/               other codecs on the same Gaussians
"""
