"""Modules that need an installable extra (optional dependency)."""
