"""Reproduction of the paper of Inoue, Yokomichi and Hiraki (2011) with the virtual rig: `analysis paper`.

This package draws the figures of the paper and assesses the claims C1 to C7 of the paper. Start with `reproduce`;
`claims` contains the verdicts. A part is a simulation or a recording with its evaluation, whose results are stored. A
bed is the granular material of a damper, which the paper describes as a single mass.
"""
