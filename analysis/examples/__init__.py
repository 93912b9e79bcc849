"""Three ways into the packages, as scripts with cell marks that notebook editors open."""
