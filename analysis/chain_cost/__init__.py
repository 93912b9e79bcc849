"""Error of a measured compliance against computing time, by detail of the measurement chain: `analysis cost`.

Start with `study`.
"""
