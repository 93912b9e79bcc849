"""Study of the measurement chain for `analysis cost`: error of a compliance and computing time, part by part.

Start with `study`.
"""
