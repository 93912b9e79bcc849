"""Parts of the instrument that every test uses."""
