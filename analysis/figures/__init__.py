"""Figures of responses, decays and modes, and the one style that all figures share.

Start with `style`.
"""
