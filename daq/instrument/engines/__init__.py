"""Engines that run tasks on the bench's clock: inputs with buffers, triggers and logs, and outputs.

An engine is made from a plan, the checked settings of one run. The package does not depend on tasks or devices.
"""
