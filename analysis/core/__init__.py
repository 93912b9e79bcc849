"""Core of the package: modules on which every analysis depends."""
