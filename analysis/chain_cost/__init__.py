"""Error of a measured compliance against computing time, over what the chain models: `analysis cost`.

Start with `study`.
"""
