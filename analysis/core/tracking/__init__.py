"""Curves of nonlinear structures over the amplitude: backbones, and responses with folds."""
