"""Core of the package: modules on which every simulation and test depends."""
