"""Curves of nonlinear structures over the amplitude: backbones."""
