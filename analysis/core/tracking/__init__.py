"""Curves of nonlinear structures against amplitude: backbones, and responses with folds."""
