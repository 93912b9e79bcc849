"""Engines that run on the clock: inputs with buffers, triggers and logs, and outputs.

This package does not depend on tasks or devices.
"""
