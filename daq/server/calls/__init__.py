"""Handlers that execute the remote calls on the instrument."""
