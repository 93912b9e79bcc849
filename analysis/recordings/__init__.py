"""What every analysis needs of a recording: slices of bounded memory, names, delays of channels.

Start with `slices`.
"""
