"""Other people's controllers as they ship, against the instrument; run by hand where there is a copy of them."""
