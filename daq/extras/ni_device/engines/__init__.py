"""Engines that run tasks on the bench's clock: acquisitions with triggers, buffers and logs, and generations.

An engine is made from a plan: the checked settings of one run. The package does not depend on tasks or devices.
"""
