"""Simulation of analog circuits and their noise, sampling skew and decimation, in compiled code.

Start with `circuit`, which describes a circuit; `discretization` computes its matrices at a sample rate, and
`propagation` its output at the samples. This package does not depend on channels or files.
"""
